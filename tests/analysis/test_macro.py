"""Macro over cells that are large enough, and Macro-9 over the paper's nine cells and no fewer."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from lerobot_roborecover.analysis import published
from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.leaderboard import make_leaderboard
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.pages.leaderboard import board_table
from lerobot_roborecover.analysis.policy_tables import beside_published, overall
from lerobot_roborecover.analysis.stats.macro import LEAST_IN_CELL, PAPER_CELLS, macro_cells
from lerobot_roborecover.analysis.summary import format_table, summarise
from lerobot_roborecover.scenario import Start
from tests.support.trial_rows import trial_row, write_log

QUICK = Options(draws=200)
OTHER = "Contact-Stage Rollback"
"""A cell that is none of the paper's nine."""


def rows_of(sizes, policy="a", seed=0, trials=2):
    """Trials on so many scenarios of each cell."""
    rng, rows = np.random.default_rng(seed), []
    for cell, size in sizes.items():
        stage, deviation = cell.split("-")
        for n in range(size):
            name = f"{cell}-{n}".replace(" ", "-").lower()
            rows += [
                trial_row(name, k, bool(rng.random() < 0.6), policy=policy, stage=stage, deviation=deviation)
                for k in range(trials)
            ]
    return rows


def nine(size=10, **other):
    return dict.fromkeys(PAPER_CELLS, size) | other


def results_of(tmp_path, *groups):
    logs = [str(write_log(tmp_path / f"{n}.jsonl", rows)) for n, rows in enumerate(groups)]
    return analyse(read_study(logs), QUICK)


def numbers(estimate):
    return estimate.value, estimate.low, estimate.high


def first(table):
    return dict(zip([c.title for c in table.columns], table.rows[0], strict=True))


def test_the_papers_nine_cells_are_those_of_its_tables():
    told = [f"{r['stage']}-{r['deviation_type']}" for r in published.table("stage_type_counts")]
    assert sorted(told) == sorted(PAPER_CELLS)


@pytest.mark.parametrize("size", [1, LEAST_IN_CELL - 1])
def test_a_small_cell_moves_neither_macro_nor_its_interval(tmp_path, size):
    """One scenario of 359 made [52.3, 64.9] of it [14.1, 88.9]."""
    without = first(overall(results_of(tmp_path / "without", rows_of(nine()))))
    table = overall(results_of(tmp_path / "with", rows_of(nine() | {OTHER: size})))
    assert numbers(first(table)["Macro-9 %"]) == pytest.approx(numbers(without["Macro-9 %"]))
    assert not any(title.startswith(("Macro-10", "Macro over")) for title in first(table))
    said = f"Left out of Macro-9, with fewer than 7 scenarios: Contact Stage Rollback ({size})."
    assert said in table.notes


def test_a_cell_of_the_least_size_counts_beside_the_papers_nine(tmp_path):
    table = overall(results_of(tmp_path, rows_of(nine() | {OTHER: LEAST_IN_CELL})))
    row = first(table)
    assert row["Macro-10 %"].value != row["Macro-9 %"].value
    assert not math.isnan(row["Macro-9 %"].low)


def test_macro_9_is_not_defined_where_one_of_the_nine_is_empty(tmp_path):
    sizes = nine() | {OTHER: 10}
    del sizes["Place-Scene Change"]
    rows = rows_of(sizes)
    results = results_of(tmp_path, rows)
    table = overall(results)
    row = first(table)
    assert math.isnan(row["Macro-9 %"].value), "nine other cells are not the paper's"
    assert not math.isnan(row["Macro over 9 cells of this set %"].value)
    assert math.isnan(row["Macro-9 % (percentile bootstrap, as in the paper)"].value)
    lacking = "Macro-9 is not defined: no scenario in 1 of the paper's nine cells (Place Scene Change)."
    assert lacking in table.notes
    beside = beside_published(results)
    own = next(r for r in beside.rows if r[1] == "this report")
    assert beside.columns[4].title == "Macro-9 %"
    assert math.isnan(own[4].value)
    assert lacking in beside.notes


def test_macro_9_has_no_interval_where_one_of_the_nine_is_small(tmp_path):
    sizes = nine() | {"Place-Scene Change": 2}
    rows = rows_of(sizes)
    table = overall(results_of(tmp_path, rows))
    row = first(table)
    means = [np.mean([r.success for r in rows if f"{r.stage}-{r.deviation}" == c]) for c in PAPER_CELLS]
    assert row["Macro-9 %"].value == pytest.approx(np.mean(means))
    assert math.isnan(row["Macro-9 %"].low)
    assert row["Macro-8 %"].value == pytest.approx(np.mean(means[:-1]))
    assert row["Macro-9 % (percentile bootstrap, as in the paper)"].low < np.mean(means), "the paper's own"
    assert any(note.startswith("Macro-9 has no interval: Place Scene Change below") for note in table.notes)


def test_a_policy_with_few_trials_of_a_cell_has_no_macro(tmp_path):
    whole = rows_of(nine())
    part = [
        replace(r, policy="b", config_hash="b")
        for r in whole
        if r.stage != "Place" or r.scenario_id.endswith(("-0", "-1"))
    ]
    results = results_of(tmp_path, whole, part)
    table = overall(results)
    b = next(dict(zip([c.title for c in table.columns], r, strict=True)) for r in table.rows if r[0] == "b")
    assert not math.isnan(b["Macro-9 %"].value)
    assert math.isnan(b["Macro-9 %"].low), "two scenarios of a cell"


def test_clusters_and_not_scenarios_make_a_cell_large():
    cells, units = ["Move-Wrong Pose"] * 20, [f"c{n // 5}" for n in range(20)]
    assert macro_cells(cells, units).sizes == {"Move-Wrong Pose": 4}
    assert macro_cells(cells, units).counted == ()


def test_run_leaderboard_and_report_print_the_same_macro(tmp_path):
    rows = rows_of(nine() | {OTHER: 3})
    row = first(overall(results_of(tmp_path / "logs", rows)))
    (board,) = make_leaderboard(tmp_path / "logs", QUICK).boards
    table = board_table(board)
    assert first(table)["Macro-9 %"] == row["Macro-9 %"]
    assert any("Contact Stage Rollback (3)" in note for note in table.notes)
    part = summarise([asdict(r) for r in rows])
    assert part.starts[Start.RECOVERY].macro == part.starts[Start.RECOVERY].macro9 == row["Macro-9 %"]
    text = format_table(part)
    assert "Left out of Macro-9, with fewer than 7 scenarios: Contact Stage Rollback (3)." in text
    assert text.count("Macro-9  ") == 1
