"""Rates, intervals and tables, against hand-worked numbers and the paper's published ones."""

import math

import numpy as np
import pytest

from lerobot_roborecover.analysis.stats.estimators import (
    RowsError,
    invalid_counts,
    macro,
    rsr,
    scenario_rates,
)
from lerobot_roborecover.analysis.summary import format_table, summarise
from lerobot_roborecover.scenario import Start
from tests.support.bootstrap import bootstrap_interval


def row(scenario, trial, outcome="success", cell="Approach-Wrong Pose", start="recovery", **more):
    stage, deviation = cell.split("-")
    return {
        "scenario_id": scenario,
        "trial": trial,
        "outcome": outcome,
        "success": outcome == "success",
        "stage": stage,
        "deviation": deviation,
        "source": "natural",
        "cluster": "",
        "start": start,
        "policy": "act@1",
    } | more


PLACE = "Place-Scene Change"
ROWS = [
    *(row("a", k, o) for k, o in enumerate(["success", "success", "horizon", "horizon"])),  # 1/2
    *(row("b", k, "success") for k in range(2)),  # 1
    *(
        row("c", k, o, PLACE) for k, o in enumerate(["sim_error", "state_mismatch", "success", "horizon"])
    ),  # 1/4
]


def test_rates_by_hand():
    rates = scenario_rates(ROWS)
    assert rates.ids == ("a", "b", "c")
    np.testing.assert_array_equal(rates.rates, [0.5, 1.0, 0.25])
    np.testing.assert_array_equal(rates.trials, [4, 2, 4])
    np.testing.assert_array_equal(rates.invalid, [0, 0, 2])
    assert rsr(rates.rates) == pytest.approx(7 / 12)
    # Cells weigh the same: (3/4 + 1/4) / 2, against 7/12 over scenarios and 5/10 over trials.
    assert macro(rates.rates, rates.cells) == pytest.approx(0.5)
    assert invalid_counts(ROWS) == {"sim_error": 1, "state_mismatch": 1}


def test_trials_without_a_row_count_as_failures():
    rates = scenario_rates(ROWS, scheduled=4)
    np.testing.assert_array_equal(rates.rates, [0.5, 0.5, 0.25])
    with pytest.raises(RowsError, match="a has 4 trials; 3 were scheduled"):
        scenario_rates(ROWS, scheduled=3)


def test_the_order_of_rows_changes_nothing():
    assert format_table(summarise(ROWS)) == format_table(summarise(ROWS[::-1]))


def test_rows_that_do_not_belong_together_are_refused():
    with pytest.raises(RowsError, match="trial 1 of b occurs 2 times"):
        scenario_rates([*ROWS, row("b", 1)])
    with pytest.raises(RowsError, match="scenario b has rows that disagree"):
        scenario_rates([*ROWS, row("b", 2, cell=PLACE)])
    with pytest.raises(RowsError, match="2 policies"):
        summarise([*ROWS, row("d", 0, policy="pi0@2")])


# Approach: Wrong Target, Wrong Pose, Stage Rollback, Scene Change; Contact: Wrong Pose; Move: Wrong Pose;
# Place: Wrong Target, Wrong Pose, Scene Change.
LIBERO_COUNTS = [25, 49, 21, 28, 12, 16, 7, 31, 11]
LIBERO_PI05 = [70.4, 59.6, 77.1, 50.0, 55.0, 71.2, 82.9, 61.3, 81.8]
ROBOTWIN_COUNTS = [29, 44, 24, 4, 21, 35, 18, 23, 2]
ROBOTWIN_FAST_WAM = [41.38, 50.0, 29.17, 75.0, 52.38, 48.57, 55.56, 65.22, 83.33]


@pytest.mark.parametrize(
    ("rates", "counts", "overall", "macro9"),
    [
        # stage_type_rates.csv, stage_type_counts.csv and overall.csv of the paper, π0.5 on LIBERO
        (LIBERO_PI05, LIBERO_COUNTS, 64.40, 67.71),
        # and Fast-WAM on RoboTwin, where the two differ most
        (ROBOTWIN_FAST_WAM, ROBOTWIN_COUNTS, 49.33, 55.62),
    ],
)
def test_published_rsr_and_macro_follow_from_the_published_cells(rates, counts, overall, macro9):
    cells = np.repeat([f"cell {i}" for i in range(9)], counts)
    values = np.repeat(rates, counts)
    assert rsr(values) == pytest.approx(overall, abs=0.03)
    assert macro(values, cells) == pytest.approx(macro9, abs=0.03)


def test_interval_of_a_mean_is_near_the_normal_one():
    rates = np.random.default_rng(1).uniform(size=200)
    low, high = bootstrap_interval(rates)
    half = 1.96 * rates.std() / math.sqrt(200)
    assert low == pytest.approx(rates.mean() - half, abs=0.003)
    assert high == pytest.approx(rates.mean() + half, abs=0.003)
    assert (low, high) == bootstrap_interval(rates)
    assert (low, high) != bootstrap_interval(rates, rng=np.random.default_rng(7))


def test_interval_of_two_scenarios_by_hand():
    # Draws of two from {0, 1}: 0 and 1 with probability 1/4 each, 1/2 otherwise.
    assert bootstrap_interval(np.array([0.0, 1.0])) == (0.0, 1.0)
    assert bootstrap_interval(np.array([0.0, 1.0]), level=0.4) == (0.5, 0.5)


def test_clusters_are_resampled_whole():
    rates = np.repeat([0.0, 1.0], 50)
    by_scenario = bootstrap_interval(rates)
    by_cluster = bootstrap_interval(rates, clusters=["x"] * 50 + ["y"] * 50)
    assert by_cluster == (0.0, 1.0)
    assert by_scenario[1] - by_scenario[0] < 0.25


def test_macro_interval_survives_empty_cells():
    low, high = bootstrap_interval(np.array([0.2, 0.2, 0.2, 0.8]), ["a", "a", "a", "b"])
    assert (low, high) == (pytest.approx(0.2), pytest.approx(0.5))


def test_nothing_to_resample():
    assert all(map(math.isnan, bootstrap_interval(np.array([0.5]))))
    assert all(map(math.isnan, bootstrap_interval(np.array([0.5, 0.1]), clusters=["x", "x"])))
    assert math.isnan(rsr(np.array([])))
    assert math.isnan(macro(np.array([]), []))


def test_summary_keeps_starts_apart():
    initial = [row(s, 0, "success", start="initial") for s in "ab"] + [
        row("c", 0, "success", PLACE, "initial")
    ]
    summary = summarise(ROWS + initial)
    assert summary.policy == "act@1"
    assert summary.starts[Start.INITIAL].rsr.value == 1.0
    recovery = summary.starts[Start.RECOVERY]
    assert (recovery.scenarios, recovery.trials) == (3, 10)
    assert recovery.rsr.value == pytest.approx(7 / 12)
    assert math.isnan(recovery.macro.value), "two cells of two and of one scenario are no Macro"
    assert recovery.macro_cells.left_out == ("Approach-Wrong Pose", PLACE)
    assert [(c.cell, c.scenarios, c.trials) for c in recovery.cells] == [
        ("Approach-Wrong Pose", 2, 6),
        (PLACE, 1, 4),
    ]


def test_table():
    initial = [row(s, 0, "success", start="initial") for s in "ab"] + [
        row("c", 0, "horizon", PLACE, "initial")
    ]
    lines = format_table(summarise(ROWS + initial)).splitlines()
    assert lines[0] == "Policy act@1"
    assert lines[3].split() == ["Initial-state", "success", "66.7", "[4.6,", "99.0]", "3", "3", "0"]
    assert lines[4].split()[:4] == ["Recovery", "success", "(RSR)", "58.3"]
    assert lines[4].split()[-3:] == ["3", "10", "2"]
    assert lines[5].split()[:3] == ["within", "2", "attempts"]
    assert lines[6].split() == ["Macro-9", "n/a"]
    assert lines[-7].split() == ["Place-Scene", "Change", "*", "25.0", "n/a", "1", "4"]
    assert lines[-6].startswith("* fewer than 10 scenarios")
    assert lines[-5] == (
        "Left out of Macro, with fewer than 7 scenarios: Approach Wrong Pose (2), Place Scene Change (1)."
    )
    assert lines[-4].startswith("Macro-9 is not defined: no scenario in 7 of the paper's nine cells (")
    assert lines[-2].endswith("counted as failures: 1 sim_error, 1 state_mismatch")
    assert lines[-1].startswith("Without those that infrastructure ended: ")
    assert len({len(line.rstrip()) for line in lines[3:5]}) == 1


def test_only_small_cells_are_marked():
    large = [row(f"s{i}", 0) for i in range(10)]
    assert "*" not in format_table(summarise(large))
    assert "Approach-Wrong Pose *" in format_table(summarise(large[1:]))


def test_invalid_trials_alone_have_no_rate():
    rows = [row(s, k, "policy_error") for s in "ab" for k in range(2)]
    table = format_table(summarise([*rows, row("a", 0, start="initial")]))
    assert "No rate from recovery starts: every trial was invalid: 4 policy_error" in table
    (line,) = (line for line in table.splitlines() if line.startswith("Recovery success"))
    assert line.split() == ["Recovery", "success", "(RSR)", "n/a", "2", "4", "4"]
    (line,) = (line for line in table.splitlines() if line.startswith("Initial-state"))
    assert line.split()[2] == "100.0"
    assert "Recovery by cell" not in table


def test_table_of_nothing():
    assert format_table(summarise([])).startswith("No trials")
