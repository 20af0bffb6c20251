"""Gains from made-up forks, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.analysis.fork_tables import gain_tables
from lerobot_roborecover.analysis.logs import RowsError, read_study
from lerobot_roborecover.analysis.pages.fork_gain import write_gains
from lerobot_roborecover.analysis.stats.fork_gain import ForkNote, fork_gains
from lerobot_roborecover.analysis.stats.intervals import difference_interval, spread
from lerobot_roborecover.analysis.stats.units import ResamplingUnit
from lerobot_roborecover.scenario import ScenarioError
from tests.support.trial_rows import trial_row, write_log


def fork(scenario, arm, won, *, step=0, trial=0, repeat=0, stream="matched", **changes):
    note = ForkNote("parent", "a" * 64, step, arm, repeat, stream)
    changes = {"options": {"fork": note.as_json()}, "config_hash": f"{arm}/{step}/{repeat}", **changes}
    return trial_row(scenario, trial, won, **changes)


def rows_by_hand():
    """Scenario 0: +1 and 0 of two trials; 1: -1; 2: 0 twice, of two steps; 3: nothing valid."""
    return [
        fork(0, "continue", False), fork(0, "fresh", True),
        fork(0, "continue", True, trial=1), fork(0, "fresh", True, trial=1),
        fork(1, "continue", True), fork(1, "fresh", False),
        fork(2, "continue", True), fork(2, "fresh", True),
        fork(2, "continue", False, step=25), fork(2, "fresh", False, step=25),
        fork(3, "continue", outcome="policy_error", won=False), fork(3, "fresh", True),
        fork(4, "continue", True), fork(4, "fresh", outcome="sim_error", won=False),
        fork(0, "continue", False, stream="own", actions_sha256="a" * 64),
        fork(1, "continue", True, stream="own", actions_sha256="b" * 64),
    ]  # fmt: skip


def test_gains_by_hand():
    gains = fork_gains(rows_by_hand())
    assert (gains.arms, gains.steps, gains.unpaired, gains.reproduced) == (("fresh",), [0, 25], 2, (1, 2))
    forks, scenarios, continued, stepped_in, gain = gains.of("fresh")
    assert (forks, scenarios) == (5, 3)
    assert continued.value == pytest.approx((0.5 + 1 + 0.5) / 3)
    assert stepped_in.value == pytest.approx((1 + 0 + 0.5) / 3)
    assert gain.value == pytest.approx((0.5 - 1 + 0) / 3)
    low, high = difference_interval(spread(np.array([0.5, -1.0, 0.0])), 0.95)
    assert (gain.low, gain.high) == pytest.approx((low, high))
    assert gains.of("fresh", step=25)[4].value == 0.0
    assert gains.of("fresh", cell="Approach / Wrong Target")[4].value == -1.0
    assert gains.of("fresh", step=25, cell="Approach / Wrong Target")[0] == 0


def test_forks_of_one_first_state_are_one_unit():
    """Scenarios that share a first state have the same initial-state trial, and its forks are the same."""
    rows = [
        fork(s, arm, arm == "fresh", start="initial", first_state=f"{s % 3:064x}")
        for s in range(12)
        for arm in ("continue", "fresh")
    ]
    assert fork_gains(rows).unit is ResamplingUnit.FIRST_STATE
    assert fork_gains(rows_by_hand()).unit is ResamplingUnit.SCENARIO
    gain = fork_gains(rows).of("fresh")[4]
    assert (gain.low, gain.high) == difference_interval(spread(np.ones(12), [s % 3 for s in range(12)]))


def test_repeats_and_steps_are_paired_each_with_its_own():
    """A fork of another repeat, step or trial is no continuation of this one."""
    rows = [fork(0, "continue", True, repeat=1), fork(0, "continue", True, step=5), fork(0, "fresh", True)]
    with pytest.raises(ScenarioError, match="none of the 1 forks"):
        fork_gains(rows)
    with pytest.raises(ScenarioError, match="has no forks"):
        fork_gains([trial_row(0)])


def test_a_report_takes_no_forks(tmp_path):
    log = write_log(tmp_path / "trials.jsonl", [trial_row(5), *rows_by_hand()[:2]])
    with pytest.raises(RowsError, match="forks of other trials"):
        read_study([str(log)])


@pytest.mark.slow
def test_tables_and_page(tmp_path):
    rows = [r for s in range(12) for arm in ("continue", "fresh", "rollback:30") for step in (0, 25)
            for r in [fork(s, arm, (s + step + len(arm)) % 3 > 0, step=step)]]  # fmt: skip
    tables = write_gains(fork_gains(rows), tmp_path, "roborecover detect fork …")
    assert [t.name for t in tables] == [
        "fork_gain", "fork_gain_by_step", "fork_gain_by_cell", "fork_gain_by_cell_and_step"
    ]  # fmt: skip
    assert [row[:2] for row in tables[0].rows] == [("fresh", 24), ("rollback:30", 24)]
    assert tables[0].sparse == frozenset()
    assert tables[2].sparse
    assert gain_tables(fork_gains(rows)) == tables
    page = (tmp_path / "gain.html").read_text()
    assert "Gain by intervention timing" in page
    assert "roborecover detect fork …" in page
    assert (tmp_path / "fork_gain.svg").read_bytes().startswith(b"<?xml")
