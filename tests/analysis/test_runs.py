"""Several runs of one method: how they are named, what is counted, what is said of runs and of methods."""

from __future__ import annotations

import json
import zlib
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.compare import compare, to_screen
from lerobot_roborecover.analysis.headline import headline
from lerobot_roborecover.analysis.leaderboard import make_leaderboard
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.named_path import split_runs
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.pages.leaderboard import board_table
from lerobot_roborecover.analysis.report_tables import all_tables
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.intervals import (
    difference_interval,
    difference_p,
    rate_interval,
    spread,
)
from lerobot_roborecover.analysis.stats.resampling import resample
from lerobot_roborecover.analysis.stats.runs import (
    RunRates,
    crossed_difference,
    crossed_spread,
    hierarchical_bootstrap,
)
from lerobot_roborecover.analysis.stats.verdicts import LEAST_RUNS, ComparisonVerdict
from lerobot_roborecover.cli.main import main
from tests.support.trial_rows import policy_rows, trial_row, write_log

QUICK = Options(draws=200)


def method(tmp_path, name, rates, count=40, trials=2, **changes):
    """`NAME=LOG,LOG,...` of runs with these rates, each with a seed and weights of its own."""
    logs = []
    for k, rate in enumerate(rates):
        seed = zlib.crc32(f"{name}{k}".encode())
        rows = policy_rows(f"{name}@{k}", count, trials, rate, seed, run_seed=k, **changes)
        logs.append(str(write_log(tmp_path / name / f"run{k}" / "trials.jsonl", rows).parent))
    return f"{name}={','.join(logs)}"


def table(results, name):
    return next(t for t in all_tables(results) if t.name == name)


def test_runs_without_a_success_say_as_much_of_other_runs_as_their_number():
    """Scenarios of one run share its weights: three runs of twenty scenarios are three, not twenty."""
    for runs, scenarios in ((3, 20), (10, 6)):
        found = rate_interval(crossed_spread(np.zeros((runs, scenarios)), resample(np.arange(scenarios))))
        assert found == pytest.approx((0, 1 - 0.025 ** (1 / min(runs, scenarios))))


def test_commas_and_equals_in_paths(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.jsonl", "b,c.jsonl", "d=1,e=2.jsonl", "x,y"):
        write_log(tmp_path / name, [trial_row(0)])
    assert split_runs("a.jsonl") == ["a.jsonl"]
    assert split_runs("b,c.jsonl") == ["b,c.jsonl"]
    assert split_runs("a.jsonl,b,c.jsonl,x,y") == ["a.jsonl", "b,c.jsonl", "x,y"]
    assert split_runs("a.jsonl,d=1,e=2.jsonl") == ["a.jsonl", "d=1,e=2.jsonl"]
    assert split_runs("a.jsonl,none.jsonl,b,c.jsonl") == ["a.jsonl", "none.jsonl", "b,c.jsonl"]
    with pytest.raises(RowsError, match=r"several runs take the name of their method: METHOD=a\.jsonl,x,y"):
        read_study(["a.jsonl,x,y"])
    assert read_study(["d=1,e=2.jsonl"]).policies == ("alpha@1",)


def test_runs_are_averaged_and_their_trials_numbered_on(tmp_path):
    study = read_study([method(tmp_path, "m", (0.3, 0.5, 0.7)), method(tmp_path, "n", (0.4,))])
    assert study.policies == ("m", "n")
    (m, n) = study.arms
    assert [name for name, _ in m.runs] == ["run0", "run1", "run2"]
    assert n.runs == ()
    assert {r.trial for r in m.rows} == set(range(6))
    results = analyse(study, QUICK)
    p = results.recovery.arm("m")
    assert (results.recovery.trials[p] == 6).all()
    means = [np.mean([r.success for r in rows]) for _, rows in m.runs]
    assert results.recovery.rates[p].mean() == pytest.approx(np.mean(means))
    rows = {row[0]: row for row in table(results, "methods").rows}
    assert rows["m"][1] == 3
    assert rows["m"][2].value == pytest.approx(np.mean(means))
    assert rows["m"][5] == pytest.approx(np.std(means, ddof=1))
    assert rows["m"][7:] == pytest.approx((min(means), max(means)))
    assert [r[1] for r in table(results, "runs").rows if r[0] == "m"] == ["run0", "run1", "run2"]
    wide, narrow = rows["m"][3], rows["m"][2]
    assert wide.high - wide.low > narrow.high - narrow.low
    assert "That is the mean of 3 runs" in headline(results) or "one run" in headline(results)


def test_one_run_a_method_changes_nothing(tmp_path):
    text = method(tmp_path, "m", (0.5,))
    results = analyse(read_study([text]), QUICK)
    assert not results.several_runs
    assert "methods" not in {t.name for t in all_tables(results)}
    assert "run" not in headline(results)


def test_what_is_no_run_of_one_method_is_refused(tmp_path):
    text = method(tmp_path, "m", (0.5, 0.5))
    first = text.removeprefix("m=").split(",")[0]
    with pytest.raises(RowsError, match=r"run0 and run0 hold the same trials.*Name each run once"):
        read_study([f"m={first},{first}"])
    rows = [replace(r, execution_horizon=5) for r in policy_rows("m@9", 40, 2, 0.5, 9)]
    other = write_log(tmp_path / "other.jsonl", rows)
    with pytest.raises(RowsError, match="runs differ in execution_horizon: 10 in run0, 5 in other"):
        read_study([f"{text},{other}"])


def test_initial_states_of_the_same_runs_come_from_logs_of_their_own(tmp_path):
    text = method(tmp_path, "m", (0.3, 0.5))
    initial = method(tmp_path / "i", "m", (0.9, 0.8), start="initial")
    results = analyse(read_study([text, initial]), QUICK)
    assert (results.initial.trials == 4).all()


def test_a_scenario_that_a_run_lacks_is_not_counted_unless_it_failed(tmp_path):
    text = method(tmp_path, "m", (0.5, 0.5), count=20)
    short = write_log(tmp_path / "short.jsonl", policy_rows("m@7", 12, 2, 0.5, 5))
    results = analyse(read_study([f"{text},{short}", method(tmp_path, "n", (0.5,), count=20)]), QUICK)
    p = results.recovery.arm("m")
    assert (results.recovery.trials[p] > 0).sum() == 12
    assert len(results.ranked.scenarios) == 12
    assert any("8 of 20 scenarios lack one of its 3 runs" in r for r in results.remarks)
    counted = analyse(read_study([f"{text},{short}"]), replace(QUICK, scheduled=2))
    assert (counted.recovery.trials == 6).all()
    assert np.isfinite(counted.runs[0].rates).all()


def test_of_methods_nothing_is_said_with_three_runs_and_something_with_more(tmp_path):
    few = [method(tmp_path, "a", (0.8, 0.82, 0.85)), method(tmp_path, "b", (0.2, 0.15, 0.2))]
    found = compare(read_study(few), options=QUICK)
    assert found.decision is ComparisonVerdict.A_BETTER
    assert found.of_methods.verdict is ComparisonVerdict.TOO_FEW_RUNS
    screen = to_screen(found)
    assert "Of the methods nothing is said, only of these runs: a has 3 and b has 3" in screen
    assert f"takes {LEAST_RUNS} runs of each" in screen.replace("\n", " ")
    assert "for other runs like these" in screen
    many = tmp_path / "many"
    logs = [method(many, "a", (0.8, 0.82, 0.85, 0.8)), method(many, "b", (0.2, 0.15, 0.2, 0.2))]
    found = compare(read_study(logs), options=QUICK)
    assert found.of_methods.verdict is ComparisonVerdict.A_BETTER
    assert "Of the methods: a is better" in to_screen(found)
    turned = compare(read_study(logs), "b", "a", QUICK).of_methods
    assert turned.verdict is ComparisonVerdict.B_BETTER
    assert turned.difference.low == pytest.approx(-found.of_methods.difference.high)


def test_runs_that_scatter_separate_runs_but_not_methods(tmp_path):
    """Four runs each: on many scenarios their means are distinguished, though both have runs everywhere."""
    logs = [
        method(tmp_path, "a", (0.95, 0.9, 0.3, 0.55), count=80, trials=5),
        method(tmp_path, "b", (0.7, 0.05, 0.5, 0.4), count=80, trials=5),
    ]
    found = compare(read_study(logs), options=QUICK)
    assert found.decision is ComparisonVerdict.A_BETTER
    assert found.of_methods.verdict is ComparisonVerdict.NOT_SEPARATED


def test_crossed_variance_is_that_of_a_balanced_layout():
    """Known by hand: runs that differ by a constant, and scenarios that do."""
    units = resample(np.arange(10))
    scenario = np.linspace(0.2, 0.6, 10)
    alike = np.stack([scenario] * 4)
    assert crossed_spread(alike, units).variance == pytest.approx(scenario.var(ddof=1) / 10)
    shifted = np.full((4, 10), 0.3) + np.array([[0.0], [0.1], [0.2], [0.1]])
    runs = np.array([0.0, 0.1, 0.2, 0.1]).var(ddof=1) / 4
    assert crossed_spread(shifted, units).variance == pytest.approx(runs)
    both = crossed_spread(scenario + np.array([[0.0], [0.1], [0.2], [0.1]]), units)
    assert both.variance == pytest.approx(runs + scenario.var(ddof=1) / 10)
    apart = crossed_difference(shifted + 0.2, shifted, units)
    assert (apart.value, apart.variance) == (pytest.approx(0.2), pytest.approx(2 * runs))
    assert np.isnan(crossed_spread(alike[:1], units).variance)


def test_p_is_the_level_at_which_the_interval_meets_zero():
    found = spread(np.random.default_rng(0).normal(0.1, 0.3, 30))
    p = difference_p(found)
    low, _ = difference_interval(found, 1 - p)
    assert low == pytest.approx(0, abs=1e-9)


def test_the_bootstrap_draws_runs_units_and_trials():
    rng = np.random.default_rng(0)
    y = rng.binomial(5, np.clip(0.5 + rng.normal(0, 0.2, (4, 1)), 0, 1), (4, 30)) / 5
    found = RunRates("m", tuple("abcd"), y, np.full(y.shape, 5))
    whole = hierarchical_bootstrap(found, resample(np.arange(30)), 400)
    assert whole.value == pytest.approx(y.mean())
    assert whole.low < y.mean(1).mean() < whole.high
    by_task = hierarchical_bootstrap(found, resample(np.arange(30) // 10), 400)
    still = hierarchical_bootstrap(found, resample(np.arange(30)), 400, trials=False)
    assert still.high - still.low < whole.high - whole.low
    assert by_task.high > by_task.low
    one = hierarchical_bootstrap(RunRates("m", ("a",), y[:1], np.full((1, 30), 5)), resample(np.arange(30)))
    assert np.isnan(one.low)


@pytest.mark.nightly
@pytest.mark.slow
def test_commands(tmp_path, capsys):
    logs = [method(tmp_path, "a", (0.8, 0.6)), method(tmp_path, "b", (0.2, 0.3))]
    out = tmp_path / "out"
    assert main(["report", *logs, "--draws=200", "--out", str(out)]) == 0
    page = (out / "report.html").read_text()
    assert "Methods and their runs" in page
    assert (out / "figures" / "runs.svg").exists()
    data = json.loads((out / "results.json").read_text())["tables"]
    assert [row[1] for row in data["runs"]["rows"]] == ["run0", "run1"] * 2
    assert main(["compare", *logs, "--draws=200", "--json"]) == 0
    capsys.readouterr()
    assert main(["compare", f"{logs[0]},{tmp_path}/none.jsonl", logs[1]]) == 2
    assert "no such file or folder" in capsys.readouterr().err


def test_a_board_by_method(tmp_path):
    for name, rates in (("a", (0.8, 0.7, 0.75)), ("b", (0.3,))):
        method(tmp_path, name, rates)
    (plain,) = make_leaderboard(tmp_path, QUICK).boards
    assert len(plain.entries) == 4
    (board,) = make_leaderboard(tmp_path, QUICK, methods=["a=a/run0,a/run1,a/run2"]).boards
    assert [e.policy for e in board.entries] == ["a", "b@0"]
    assert [e.runs for e in board.entries] == [3, 1]
    assert board.entries[0].other_runs.low < board.entries[0].rsr.low
    text = board_table(board)
    assert "Runs" in [c.title for c in text.columns]
    assert len(board.entries[0].provenance.logs) == 3
    with pytest.raises(RowsError, match="no such log below"):
        make_leaderboard(tmp_path, QUICK, methods=["a=a/run0,a/run9"])
