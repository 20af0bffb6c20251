"""Which trial logs may be analysed together: what is merged, what is remarked on, what is refused."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import replace

import pytest

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.summary import Estimate
from lerobot_roborecover.analysis.tables import Column, Table, to_csv, to_markdown
from lerobot_roborecover.logs.trial_log import TrialLogError
from tests.support.trial_rows import trial_row, write_log


def log(tmp_path, rows, name="trials"):
    return str(write_log(tmp_path / f"{name}.jsonl", rows))


def test_a_line_cut_off_by_a_crash(tmp_path):
    path = write_log(tmp_path / "log.jsonl", [trial_row(n) for n in range(3)])
    path.write_text(path.read_text()[:-30])
    study = read_study([str(path)])
    assert len(study.arms[0].rows) == 2
    assert "cut off by a crash" in study.remarks[0]


def test_the_same_row_in_two_logs_counts_once(tmp_path):
    first = log(tmp_path, [trial_row(n) for n in range(3)], "one")
    second = log(tmp_path, [trial_row(n) for n in range(2, 5)], "two")
    study = read_study([first, second])
    assert len(study.arms[0].rows) == 5
    assert "1 row(s) occur in more than one log" in study.remarks[0]
    conflict = log(tmp_path, [trial_row(0, success=False)], "three")
    with pytest.raises(RowsError, match=r"three\.jsonl, line 1: field 'outcome': trial 0 of s000 by"):
        read_study([first, conflict])
    named = read_study([first, f"other={conflict}"])
    assert named.policies == ("alpha@1", "other")


REFUSALS = {
    "platforms": ([trial_row(0), trial_row(1, platform="metaworld")], "2 platforms (libero, metaworld)"),
    "scenario sets": (
        [trial_row(0), trial_row(0, policy="b", scenario_sha256="f" * 64)],
        "different scenario sets",
    ),
    "horizons": (
        [trial_row(0), trial_row(0, policy="b", horizon=99, steps=9)],
        "has horizon 300 for alpha@1",
    ),
    "labels": ([trial_row(0), trial_row(0, policy="b", stage="Place")], "has stage 'Approach'"),
    "simulators": (
        [trial_row(0), trial_row(0, policy="b", versions={"mujoco": "3.4.0"})],
        "mujoco differs: 3.3.2",
    ),
    "handoff": (
        [trial_row(0), trial_row(0, policy="b", options={"handoff_check": False})],
        "handoff was checked for alpha",
    ),
    "approximate snapshots": (
        [trial_row(0), trial_row(0, policy="b", options={"approximate_snapshots": True})],
        "trials of b started from approximate snapshots, and those of alpha@1 from exact replays",
    ),
    "settings": (
        [trial_row(0), trial_row(1, config_hash="other", run_seed=7)],
        "recovery trials under 2 settings, which differ in run_seed (1000 / 7)",
    ),
    "starts": (
        [trial_row(0, start="initial")],
        "no trials from recovery points by a policy without an intervention (there are: initial)",
    ),
}


def test_pictures_of_different_quality_are_remarked(tmp_path):
    rows = [
        trial_row(0, policy=quality, options={"render_quality": quality})
        for quality in ("rt", "trivial", "none")
    ]
    remarks = read_study([log(tmp_path, rows)]).remarks
    assert any("render quality differs" in r and "rt (rt), trivial (trivial)" in r for r in remarks)
    assert not read_study([log(tmp_path, rows[1:])]).remarks
    # LIBERO and Meta-World note it only where it is not LeRobot's own.
    plain = [trial_row(0, policy="plain"), rows[1]]
    assert any("full (plain), trivial (trivial)" in r for r in read_study([log(tmp_path, plain)]).remarks)


@pytest.mark.parametrize("case", REFUSALS)
def test_logs_that_do_not_belong_together_are_refused(tmp_path, case):
    rows, message = REFUSALS[case]
    with pytest.raises(RowsError, match=re.escape(message)):
        analyse(read_study([log(tmp_path, rows)]), Options(draws=200))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"outcome": "won", "success": False}, "outcome 'won' is not one of"),
        ({"success": True, "outcome": "horizon"}, "success is True but the outcome is 'horizon'"),
        ({"steps": -1}, "line 1: field 'steps': steps is -1, not a count"),
        ({"steps": "many"}, "steps is 'many', not a count"),
        ({"stage": "Grasp"}, "stage 'Grasp' is not one of"),
        ({"versions": []}, "versions is [], not a dict"),
        ({"policy": None}, "policy is None, not text"),
        ({"cluster": 3}, "cluster is 3, not text"),
    ],
)
def test_damaged_rows_are_refused(tmp_path, change, message):
    row = replace(trial_row(0), **change)
    with pytest.raises(TrialLogError, match=re.escape(message)):
        read_study([log(tmp_path, [row])])


def test_nothing_to_read(tmp_path):
    with pytest.raises(RowsError, match="no trial rows"):
        read_study([log(tmp_path, [])])
    with pytest.raises(TrialLogError, match="cannot read trial log"):
        read_study([str(tmp_path / "none.jsonl")])
    (tmp_path / "empty").mkdir()
    with pytest.raises(TrialLogError, match="no trial log in"):
        read_study([str(tmp_path / "empty")])


def test_one_platform_can_be_taken(tmp_path):
    rows = [trial_row(0), trial_row(1, platform="metaworld")]
    study = read_study([log(tmp_path, rows)], platform="metaworld")
    assert [r.scenario_id for arm in study.arms for r in arm.rows] == ["s001"]


def test_a_folder_stands_for_its_logs_and_a_name_for_its_one_policy(tmp_path):
    log(tmp_path, [trial_row(0)], "part-0")
    log(tmp_path, [trial_row(1)], "part-1")
    assert len(read_study([str(tmp_path)]).arms[0].rows) == 2
    assert read_study([f"mine={tmp_path}"]).policies == ("mine",)
    both = log(tmp_path, [trial_row(0), trial_row(0, policy="other")], "both")
    with pytest.raises(RowsError, match="no one NAME fits"):
        read_study([f"mine={both}"])


def test_estimates_become_three_csv_columns():
    t = Table(
        "t", "T", (Column("Policy"), Column("RSR", "percent"), Column("N", "count")),
        (("a", Estimate(0.5, 0.25, 0.75), 3), ("b", Estimate(0.5, float("nan"), float("nan")), 1)),
    )  # fmt: skip
    rows = list(csv.reader(io.StringIO(to_csv(t))))
    assert rows[0] == ["Policy", "RSR", "RSR low", "RSR high", "N"]
    assert rows[1:] == [["a", "0.5", "0.25", "0.75", "3"], ["b", "0.5", "n/a", "n/a", "1"]]
    assert "| a | 50.0 [25.0, 75.0] | 3 |" in to_markdown(t)
    with pytest.raises(ValueError, match="a row has 1 cells for 2 columns"):
        Table("t", "T", (Column("x"), Column("y")), (("a",),))
