"""Intervals hold what they promise: a sliver of benchmarks/coverage.py; one estimator behind every table."""

from __future__ import annotations

import importlib.util
import math
import sys
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.compare import compare
from lerobot_roborecover.analysis.leaderboard import make_leaderboard
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.policy_tables import overall
from lerobot_roborecover.analysis.stats.arms import Arm
from lerobot_roborecover.analysis.stats.contrasts import holm
from lerobot_roborecover.analysis.stats.crossfit import gain_over, oracle, profile_difference
from lerobot_roborecover.analysis.stats.intervals import difference_interval, rate_interval, spread
from lerobot_roborecover.analysis.stats.panel import make_panel
from lerobot_roborecover.analysis.stats.permutation import sign_flip_p
from lerobot_roborecover.analysis.stats.resampling import resample
from lerobot_roborecover.analysis.stats.units import ResamplingUnit
from lerobot_roborecover.analysis.summary import summarise
from lerobot_roborecover.cli.main import main
from lerobot_roborecover.evaluation.progress import RunProgress
from lerobot_roborecover.scenario import Start
from tests.support.trial_rows import policy_rows, trial_row, write_log


@pytest.fixture(scope="module")
def benchmark():
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "coverage.py"
    spec = importlib.util.spec_from_file_location("coverage_benchmark", path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(path.parent)
        spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize(
    "part",
    [
        *("rates", "retries", "macro", "steps", "tests"),
        *(
            pytest.param(part, marks=pytest.mark.nightly)
            for part in ("tasks", "ratios", "differences", "agreement")
        ),
    ],
)
def test_intervals_cover_and_tests_are_right(benchmark, part):
    """The sizes 8 and 20 of the benchmark, where few samples still tell; seeded, so that it cannot flicker.

    Three standard errors are allowed for: the whole benchmark, with many samples, allows for none.
    """
    lines = [line for line in benchmark.PARTS[part](400) if line.n <= 20]
    assert len({line.n for line in lines}) == 2
    assert not [line for line in lines if benchmark.too_far([line], slack=_slack(line))]


def _slack(line) -> float:
    share = 0.06 if line.size else 0.92
    return 3 * math.sqrt(share * (1 - share) / line.samples)


@pytest.mark.nightly
def test_cross_fitted_choices_and_monitors_are_covered(benchmark, monkeypatch):
    for module in (benchmark.settings, benchmark.labels):
        monkeypatch.setattr(module, "SIZES", (20,))
    for part in ("chosen", "monitor"):
        lines = list(benchmark.PARTS[part](400))
        assert not [line for line in lines if benchmark.too_far([line], slack=_slack(line))]


@pytest.mark.nightly
def test_runs_and_looks_are_covered(benchmark, monkeypatch):
    monkeypatch.setattr(benchmark.settings, "SIZES", (20,))
    monkeypatch.setattr(benchmark.several, "RUNS", (3,))
    monkeypatch.setattr(benchmark.several, "BETWEEN", (0.0, 0.8))
    lines = [line for part in ("runs", "looks") for line in benchmark.PARTS[part](800)]
    assert not [line for line in lines if benchmark.too_far([line], slack=_slack(line))]
    shares = {}
    for line in lines:
        shares.setdefault(line.what, []).append(line.share)
    assert max(shares["the same, from these runs alone"]) > 0.1, "runs that scatter pass for methods"


@pytest.mark.nightly
def test_shared_first_states_are_covered(benchmark, monkeypatch):
    """By first state; over scenarios, as it was, intervals are too narrow and the test is wrong too often."""
    monkeypatch.setattr(benchmark.shared, "SIZES", (64,))
    lines = list(benchmark.shared.first_states(800))
    assert not [line for line in lines if benchmark.too_far([line], slack=_slack(line))]
    by_scenario = [line for line in lines if line.what.endswith(", over scenarios")]
    assert min(line.share for line in by_scenario if not line.size) < 0.87
    assert max(line.share for line in by_scenario if line.size) > 0.1


def test_the_percentile_bootstrap_misses(benchmark, monkeypatch):
    """The benchmark can tell: what the paper's bootstrap does at 8 scenarios is far below."""
    monkeypatch.setattr(benchmark.settings, "SIZES", (8,))
    lines = list(benchmark.settings.bootstrap(200))
    assert min(line.share for line in lines) < 0.5
    assert not benchmark.too_far(lines), "it is there to compare with"


def test_many_sign_flips_at_once_are_those_one_by_one(benchmark):
    rng = np.random.default_rng(0)
    for n, most in ((3, 1), (8, 5), (40, 5), (12, 20)):
        d = rng.integers(-most, most + 1, (20, n))
        d[0] = 0
        one_by_one = [sign_flip_p(row.astype(float)) for row in d]
        assert benchmark.settings.sign_flips(d) == pytest.approx(one_by_one, abs=1e-12)


@pytest.mark.slow
@pytest.mark.nightly
def test_holm_is_that_of_statsmodels():
    from statsmodels.stats.multitest import multipletests

    p = np.random.default_rng(0).random((30, 15)) ** 3
    p[0, :4] = p[0, 4]
    assert holm(p) == pytest.approx(np.array([multipletests(row, method="holm")[1] for row in p]))
    assert holm(np.zeros(0)).shape == (0,)


def test_columns_are_one_by_one_what_they_are_together():
    rng = np.random.default_rng(0)
    y = np.where(rng.random((6, 25)) < 0.1, np.nan, rng.binomial(5, 0.4, (6, 25)) / 5)
    units, cells = rng.integers(0, 9, 25), rng.integers(0, 4, 25)
    for options in ({}, {"units": units}, {"units": units, "cells": cells}, {"weights": rng.random((6, 25))}):
        together = spread(y, **options)
        for k in range(6):
            own = {**options, "weights": options["weights"][k]} if "weights" in options else options
            alone = spread(y[k], **own)
            assert alone == tuple_of(together, k)
            for interval in (rate_interval, difference_interval):
                assert interval(alone) == tuple(bound[k] for bound in interval(together))


def tuple_of(found, k):
    return type(found)(*(getattr(found, field.name)[k] for field in fields(found)))


def test_too_far_says_what_misses(benchmark):
    line = benchmark.Line
    good = line("rate", 8, "", 0.91, 0.1, 100)
    bad = [line("rate", 20, "", 0.91, 0.1, 100), line("15 pairs", 20, "", 0.07, math.nan, 100, size=True)]
    assert benchmark.too_far([good, *bad]) == bad
    assert "91.0 (91.0)" in benchmark.table([good], False)


def test_nothing_is_certain_from_few_scenarios():
    assert rate_interval(spread(np.ones(2)))[0] < 0.2
    low, high = rate_interval(spread(np.zeros(20)))
    assert (low, 0.1 < high < 0.3) == (0, True)
    assert rate_interval(spread(np.full(64, 1.0)))[1] == 1


@pytest.mark.parametrize(("successes", "n"), [(2, 2), (0, 6), (0, 20), (9, 9), (0, 359)])
@pytest.mark.parametrize("level", [0.95, 0.8])
def test_a_group_without_success_or_without_failure_has_the_exact_interval(successes, n, level):
    exact = stats.binomtest(successes, n).proportion_ci(level, "exact")
    found = rate_interval(spread(np.full(n, successes / n)), level)
    assert found == pytest.approx((exact.low, exact.high))


def test_the_exact_interval_counts_independent_units_not_scenarios():
    labels = [f"c{i // 3}" for i in range(18)]
    exact = stats.binomtest(0, 6).proportion_ci(method="exact")
    assert rate_interval(spread(np.zeros(18), labels)) == pytest.approx((exact.low, exact.high))


def test_no_rates_of_unequal_units_make_a_run_of_failures_likelier_than_its_bound_says():
    """The bound is the largest mean rate at which all units fail with chance .025, found here by search."""
    weights = np.array([0.5, 0.25, 0.25])
    fail = np.linspace(0.025, 1, 300)
    first, second = np.meshgrid(fail, fail)
    third = 0.025 / (first * second)
    means = 1 - np.tensordot(weights, [first, second, third], 1)
    searched = means[third <= 1].max()
    bound = rate_interval(spread(np.zeros(4), list("aabc")))[1]
    assert searched <= bound + 1e-9
    assert bound == pytest.approx(searched, abs=1e-3)


@pytest.mark.parametrize("scatter", [0.3, 1.0, 1e9])
@pytest.mark.parametrize("trials", [1, 5])
def test_few_scenarios_without_success_are_covered_however_they_scatter(scatter, trials):
    rng = np.random.default_rng(0)
    for n in (2, 4, 8):
        for p in (0.05, 0.3, 0.6):
            rates = rng.beta(p * scatter, (1 - p) * scatter, (2000, n))
            y = rng.binomial(trials, rates) / trials
            low, high = rate_interval(spread(y))
            missed = ((high < p) & (y == 0).all(1)) | ((low > p) & (y == 1).all(1))
            assert missed.mean() <= 0.025 + 3 * math.sqrt(0.025 / 2000)


def test_hand_worked_intervals():
    y = np.array([1, 0, 0, 1, 1, 1, 0, 1, 1, 1], float)
    found = spread(y)
    assert (found.value, found.effective, found.freedom) == (0.7, pytest.approx(10), pytest.approx(9))
    assert found.variance == pytest.approx(y.var(ddof=1) / 10)
    t = stats.t.ppf(0.975, 9)
    mixed = (9 * y.var(ddof=1) / 10 + 0.21 / 10) / 10
    n = 0.21 / mixed
    centre = (0.7 * n + t * t / 2) / (n + t * t)
    half = t * math.sqrt(centre * (1 - centre) / (n + t * t))
    assert rate_interval(found) == pytest.approx((centre - half, centre + half))
    d = np.array([1, 0, 0, -1, 1, 1, 0, 1, 0, 0], float)
    more = np.append(d, 0)  # one unit more: its mean is 0, its square is 1
    scatter = ((d**2).sum() + 1) / 11 - more.mean() ** 2
    half = t * math.sqrt(scatter / 11)
    assert difference_interval(spread(d)) == pytest.approx((more.mean() - half, more.mean() + half))


def test_units_enter_with_their_totals_and_cells_with_their_means():
    y, unit = np.array([1, 1, 1, 0, 0, 0.5]), list("aaabbc")
    found = spread(y, unit)
    residual = y - y.mean()
    totals = [residual[:3].sum(), residual[3:5].sum(), residual[5]]
    assert found.variance == pytest.approx(3 / 2 * sum(t * t for t in totals) / 36)
    assert found.effective == pytest.approx(36 / (9 + 4 + 1))
    cells = spread(y, cells=unit)
    assert cells.value == pytest.approx((1 + 0 + 0.5) / 3)


@pytest.mark.slow
def test_one_estimator_behind_every_table(tmp_path, capsys):
    """LIBERO with clusters: the run's table took them as units and the report did not."""
    rows = [replace(r, cluster=f"c{int(r.scenario_id[1:]) // 4}") for r in policy_rows("a", 40, 3, 0.5, 0)]
    path = write_log(tmp_path / "logs" / "a.jsonl", rows)
    rival = [replace(r, cluster=f"c{int(r.scenario_id[1:]) // 4}") for r in policy_rows("b", 40, 3, 0.5, 1)]
    other = write_log(tmp_path / "b.jsonl", rival)
    plain = analyse(read_study([str(path)]))
    run = summarise([asdict(r) for r in rows]).starts[Start.RECOVERY]
    row = dict(zip([c.title for c in overall(plain).columns], overall(plain).rows[0], strict=True))
    (board,) = make_leaderboard(tmp_path / "logs").boards
    both = compare(read_study([str(path), str(other)]))
    counts = RunProgress("recovery", {r.scenario_id for r in rows}, 3)
    counts.add([asdict(r) for r in rows])
    assert run.rsr == row["RSR %"] == board.entries[0].rsr == both.rsr[0]
    assert counts.interval == (run.rsr.low, run.rsr.high)
    assert run.macro == row["Macro-4 %"] == board.entries[0].macro
    by_trajectory = analyse(plain.study, Options(cluster=ResamplingUnit.TRAJECTORY))
    wide = by_trajectory.ranked_rates[0]
    assert (by_trajectory.draws.units, by_trajectory.unit) == (10, "trajectory clusters")
    assert wide.high - wide.low > run.rsr.high - run.rsr.low
    assert main(["report", str(path), f"--out={tmp_path / 'out'}", "--draws=200", "--cluster=task"]) == 0
    assert "over 10 tasks" in capsys.readouterr().out.replace("(10 of them)", "over 10 tasks")
    robotwin = [replace(r, platform="robotwin") for r in rows]
    assert analyse(read_study([str(write_log(tmp_path / "r.jsonl", robotwin))])).draws.units == 10


def coin_flips(count=40, policies=6, trials=5, seed=0, rate=0.5):
    rng = np.random.default_rng(seed)
    arms = [
        [
            trial_row(n, k, bool(rng.random() < rate), policy=f"p{p}")
            for n in range(count)
            for k in range(trials)
        ]
        for p in range(policies)
    ]
    return make_panel([Arm(rows[0].policy, Start.RECOVERY, (0,), tuple(rows)) for rows in arms])


@pytest.mark.slow
def test_six_identical_coins_gain_nothing():
    gains, sources, profiles = [], [], []
    for seed in range(8):
        panel = coin_flips(seed=seed)
        draws = resample(panel.units())
        found = oracle(panel, draws)
        assert found.hindsight_gain.value > 0.15, "in hindsight it looks like a gain"
        assert found.floor.low - 0.05 < found.hindsight_gain.value < found.floor.high + 0.05
        assert found.gain.low < 0 < found.gain.high
        gains.append(found.gain.value)
        sources.append(gain_over(panel.successes, panel.trials, 0, [1, 2, 3, 4, 5], draws).value)
        pair = profile_difference(panel, 0, 1, draws)
        assert pair.hindsight > 0.15
        assert pair.floor.low - 0.05 < pair.hindsight < pair.floor.high + 0.05
        profiles.append(pair.difference.value)
    for values in (gains, sources, profiles):
        assert abs(np.mean(values)) < 0.05


def test_single_trials_cannot_choose_and_score():
    panel = coin_flips(trials=1)
    draws = resample(panel.units())
    found = oracle(panel, draws)
    assert math.isnan(found.gain.value)
    assert found.floor.value == pytest.approx(found.hindsight_gain.value, abs=0.12)
    assert math.isnan(profile_difference(panel, 0, 1, draws).difference.value)
    halves = gain_over(panel.successes, panel.trials, 0, [1, 2, 3, 4, 5], draws)
    assert abs(halves.value) < 0.35, "the scenarios are halved instead"


def test_a_real_specialist_is_found():
    """Each policy solves its own half of the scenarios: choosing by scenario is worth 50 points."""
    arms = [
        Arm(f"p{p}", Start.RECOVERY, (0,), tuple(
            trial_row(n, k, n % 2 == p, policy=f"p{p}") for n in range(30) for k in range(4)
        ))
        for p in range(2)
    ]  # fmt: skip
    panel = make_panel(arms)
    found = oracle(panel, resample(panel.units()))
    assert found.gain.value == pytest.approx(0.5)
    assert found.gain.low > 0.2
