"""RSR@k and success against a budget of steps: by hand, and as properties."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.retry_tables import retried, retry_tables
from lerobot_roborecover.analysis.stats.retries import rates_for_steps, rates_within, share_within
from lerobot_roborecover.analysis.summary import format_table, summarise
from lerobot_roborecover.scenario import Start
from tests.support.trial_rows import policy_rows, trial_row, write_log


def results_of(folder, rows, *more, **options):
    logs = [str(write_log(folder / f"{k}.jsonl", own)) for k, own in enumerate((rows, *more))]
    return analyse(read_study(logs), Options(draws=100, **options))


def attempts(folder, rows, **options):
    return retried(results_of(folder, rows, **options))[0].attempts


def test_rsr_at_k_by_hand():
    """Five trials with two successes: 2/5, 1 - 3/10, 1 - 1/10, then no choice of four is without one."""
    trials = np.array([5, 5, 5, 3])
    found = [share_within(np.array([2, 0, 5, 1]), trials, k) for k in (1, 2, 3, 4, 5)]
    np.testing.assert_allclose(np.array(found)[:, 0], [0.4, 0.7, 0.9, 1, 1])
    np.testing.assert_allclose(np.array(found)[:, 1], 0)
    np.testing.assert_allclose(np.array(found)[:, 2], 1)
    np.testing.assert_allclose(np.array(found)[:, 3], [1 / 3, 2 / 3, 1, np.nan, np.nan])


def test_table_by_hand(tmp_path):
    """Two scenarios of three trials, 1 and 0 successes: 1/6, 1/3, 1/2. The page, CSV and `eval` say it."""
    outcomes = {0: [False, True, False], 1: [False, False, False]}
    rows = [trial_row(n, k, s, horizon=100, steps=40 if s else 100) for n, own in outcomes.items()
            for k, s in enumerate(own)]  # fmt: skip
    results = results_of(tmp_path, rows)
    within, budgets = retry_tables(results)
    assert [c.title for c in within.columns] == ["Policy", "RSR@1 %", "RSR@2 %", "RSR@3 %"]
    assert [e.value for e in within.rows[0][1:]] == pytest.approx([1 / 6, 1 / 3, 1 / 2])
    assert [e.low <= e.value <= e.high for e in within.rows[0][1:]] == [True] * 3
    assert within.rows[0][1] == results.ranked_rates[0], "RSR@1 is RSR, with its interval"
    # The success takes 40 steps; after one failure 140, after two 240.
    assert [c.title for c in budgets.columns[1:]] == [f"{b} × horizon" for b in ("0.5", "1", "1.5", "2", "3")]
    assert [e.value for e in budgets.rows[0][1:]] == pytest.approx([1 / 6, 1 / 6, 1 / 3, 1 / 3, 1 / 2])
    summary = summarise([asdict(row) for row in rows])
    assert [e.value for e in summary.starts[Start.RECOVERY].within.values()] == pytest.approx([1 / 3, 1 / 2])
    assert "  within 3 attempts          50.0" in format_table(summary)


@st.composite
def outcomes(draw):
    """Trials of a scenario: successes of 1 to 100 steps, failures at the horizon of 100, or sooner."""
    count = draw(st.integers(2, 5))
    one = st.one_of(st.tuples(st.just("success"), st.integers(1, 100)), st.just(("horizon", 100)),
                    st.tuples(st.just("sim_error"), st.integers(0, 99)))  # fmt: skip
    return draw(st.lists(st.lists(one, min_size=count, max_size=count), min_size=1, max_size=3))


def rows_of(scenarios):
    return [
        trial_row(n, k, outcome=outcome, steps=steps, horizon=100)
        for n, trials in enumerate(scenarios)
        for k, (outcome, steps) in enumerate(trials)
    ]


@settings(max_examples=40, deadline=None)
@given(outcomes(), st.randoms(use_true_random=False))
def test_retries_as_properties(tmp_path_factory, scenarios, random):
    """RSR at k = 1, monotone, deaf to the order of trials, and what all choices and all orders count out."""
    folder = tmp_path_factory.mktemp("retries")
    results = results_of(folder, rows_of(scenarios))
    if all(outcome == "sim_error" for trials in scenarios for outcome, _ in trials):
        assert retried(results) == [], "no rate over invalid trials alone"
        return
    found = retried(results)[0].attempts
    count, grid = len(scenarios[0]), np.linspace(0, len(scenarios[0]), 9)
    ks = range(1, count + 1)
    within, spent = rates_within(found, ks), rates_for_steps(found, grid)
    np.testing.assert_allclose(within[:, 0], results.recovery.rates[0])
    assert (np.diff(within) >= -1e-12).all()
    assert (np.diff(spent) >= -1e-12).all()
    mixed = [random.sample(trials, count) for trials in scenarios]
    other = attempts(folder, rows_of(mixed))
    np.testing.assert_allclose(rates_within(other, ks), within)
    np.testing.assert_allclose(rates_for_steps(other, grid), spent)
    for n, trials in enumerate(scenarios):
        solved = [outcome == "success" for outcome, _ in trials]
        for k in ks:
            assert math.isclose(within[n, k - 1], np.mean([any(c) for c in combinations(solved, k)]))
        firsts = [first_success(order) for order in permutations(trials)]
        np.testing.assert_allclose(spent[n], [np.mean([f <= 100 * b for f in firsts]) for b in grid])


def first_success(order):
    """Steps up to and with the first success; infinite without one."""
    total = 0
    for outcome, steps in order:
        total += steps
        if outcome == "success":
            return total
    return math.inf


def test_a_retry_of_a_deterministic_policy_brings_nothing(tmp_path):
    """Trials that are all alike are said to be; one other action sequence among them, and nothing is said."""
    rows = [trial_row(n, k, n < 3, actions_sha256=f"{n:064x}") for n in range(6) for k in range(3)]
    (within, _) = retry_tables(results_of(tmp_path, rows))
    assert [e.value for e in within.rows[0][1:]] == [0.5] * 3
    assert "A retry of a deterministic policy brings nothing" in within.notes[-1]
    rows[1] = replace(rows[1], actions_sha256="f" * 64)
    (within, _) = retry_tables(results_of(tmp_path, rows))
    assert not any("deterministic" in note for note in within.notes)


def test_what_has_no_retries_says_nothing_of_them(tmp_path):
    """Single trials have no table; a scenario with one trial fewer leaves the largest k undefined."""
    single = [trial_row(n) for n in range(4)]
    assert retry_tables(results_of(tmp_path, single)) == []
    assert "attempts" not in format_table(summarise([asdict(row) for row in single]))
    rows = [
        row for row in policy_rows("alpha@1", 8, 3, 0.5, 0) if (row.scenario_id, row.trial) != ("s000", 2)
    ]
    whole = policy_rows("beta@2", 8, 3, 0.5, 1)
    (within, _) = retry_tables(results_of(tmp_path, rows, whole, common=True))
    of = {row[0]: row[1:] for row in within.rows}
    assert math.isnan(of["alpha@1"][2].value)
    assert not math.isnan(of["beta@2"][2].value)
    assert "Fewer trials of some scenario: alpha@1." in within.notes
    # With --trials the missing one is a failure, and there is nothing undefined.
    (within, _) = retry_tables(results_of(tmp_path, rows, whole, scheduled=3))
    assert not any(math.isnan(e.value) for row in within.rows for e in row[1:])


def test_a_policy_with_invalid_trials_alone_has_no_row(tmp_path):
    rows = policy_rows("alpha@1", 8, 3, 0.5, 0)
    broken = [replace(row, outcome="sim_error", success=False) for row in policy_rows("beta@2", 8, 3, 0.5, 1)]
    for table in retry_tables(results_of(tmp_path, rows, broken)):
        assert [row[0] for row in table.rows] == ["alpha@1"]


def test_interventions_have_a_row_and_runs_are_no_retries(tmp_path):
    """A method of two runs of one trial each has no second attempt: another training is no retry."""
    base = policy_rows("base@1", 8, 3, 0.5, 0)
    acting = policy_rows("monitor@2", 8, 3, 0.6, 1, interventions=[{"kind": "rollback", "step": 3}])
    (within, budgets) = retry_tables(results_of(tmp_path, base, acting))
    assert [row[0] for row in within.rows] == [row[0] for row in budgets.rows] == ["base@1", "monitor@2"]
    runs = [write_log(tmp_path / f"run{k}.jsonl", policy_rows(f"m@{k}", 8, 1, 0.5, k, run_seed=k))
            for k in range(2)]  # fmt: skip
    study = read_study([f"method={runs[0]},{runs[1]}"])
    assert retry_tables(analyse(study, Options(draws=100))) == []
