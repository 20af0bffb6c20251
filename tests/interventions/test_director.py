"""Who acts in a slot, step by step: the composite policy's director alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.policies.interventions.control_columns import append_columns, strip_columns
from lerobot_roborecover.policies.runner import Act, Controller, PolicyError, Rollback
from tests.support.small_interventions import CountingMember, FrameDetector, ScriptedController, observation

pytestmark = pytest.mark.lerobot


def director(mode, *, monitor=None, takeover=None, correction_steps=5):
    from lerobot_roborecover.policies.interventions.controller import InterventionController

    members = {Controller.BASE: CountingMember(1.0, 4), Controller.CORRECTION: CountingMember(2.0, 3)}
    return InterventionController(
        members, mode, monitor=monitor, takeover=takeover, correction_steps=correction_steps
    )


def turns(decision):
    """A decision as LeRobot's loop carries it: one per turn, read from the columns of a row."""
    return strip_columns(append_columns(decision, 3), 3)


def said(rows, at):
    """Value `at` of each turn's action; 0 for a rollback, as in the row of zeros that carries it."""
    return [0.0 if isinstance(r, Rollback) else r.actions[0, at] for r in rows]


def run_alone(made, values, bad=()):
    """Turns of one slot that sees these values, one a step; whole chunks are executed blindly."""
    episode = made.start(7)
    rows = []
    while len(rows) < len(values):
        step = len(rows)
        (chunk,) = made.act([observation(values[step], step in bad)], ["go"], [episode])
        if isinstance(chunk, PolicyError):
            return rows, chunk
        rows += turns(chunk)
    made.finish(episode)
    return rows[: len(values)], None


class At(FrameDetector):
    """A monitor that triggers wherever the observation is 9, and cannot be read where it is 8."""

    max_batch = 2

    def __init__(self):
        super().__init__()
        self.asked = []

    def judge(self, observations, instructions):
        from lerobot_roborecover.policies.detectors.interface import Verdicts

        values = observations["observation.state"][:, 0].numpy()
        self.asked += values.tolist()
        scores = np.where(values == 8, np.nan, values / 10).astype(np.float32)
        return Verdicts(scores, (values == 9) | (values == 8))


def test_correction_acts_for_its_steps_and_both_sides_begin_afresh():
    made = director("correction")
    rows, _ = run_alone(made, [0.0] * 10)
    who_and_step = list(zip(said(rows, 0), said(rows, 1), strict=True))
    assert who_and_step == [(2, 0), (2, 1), (2, 2), (2, 3), (2, 4), (1, 0), (1, 1), (1, 2), (1, 3), (1, 4)]
    assert [r.mark.controller for r in rows] == [Controller.CORRECTION] * 5 + [Controller.BASE] * 5
    assert not any(r.mark.asked for r in rows)
    for member in made.members.values():
        assert member.begun == member.finished


def test_the_monitor_is_asked_every_step_until_it_triggers_once():
    monitor = At()
    made = director("monitor_correction", monitor=monitor)
    values = [1, 8, 2, 9, 9, 9, 9, 9, 9, 9]
    rows, _ = run_alone(made, values)
    assert monitor.asked == [1, 8, 2, 9]
    assert [r.mark.asked for r in rows] == [True] * 4 + [False] * 6
    assert said(rows, 0) == [1, 1, 1, 2, 2, 2, 2, 2, 1, 1]
    # The base's chunk of four is cut after three; when it is back, it begins anew.
    assert said(rows, 1) == [0, 1, 2, 0, 1, 2, 3, 4, 0, 1]
    assert rows[3].mark.score == pytest.approx(0.9)
    assert np.isnan(rows[1].mark.score)


def test_a_monitored_rollback_takes_a_turn_and_flushes_the_queue():
    made = director("monitor_reversion", monitor=At())
    rows, _ = run_alone(made, [1, 2, 9, 3, 3, 3])
    assert [type(r) for r in rows] == [Act, Act, Rollback, Act, Act, Act]
    assert rows[2].steps is None, "the paper's number"
    assert rows[2].mark.asked
    assert said(rows, 1) == [0, 1, 0, 0, 1, 2]
    assert (append_columns(rows[2], 3)[0, :3] == 0).all()


def test_a_person_takes_over_and_hands_back():
    takeover = ScriptedController(3)
    takeover.act = lambda slot, seen: (
        None if not slot["left"] else (slot.update(left=slot["left"] - 1), np.full(3, 5.0, np.float32))[1]
    )
    made = director("human", monitor=At(), takeover=takeover)
    rows, _ = run_alone(made, [1, 9, 0, 0, 0, 0, 0])
    assert said(rows, 0) == [1, 5, 5, 5, 1, 1, 1]
    assert [s["over"] for s in takeover.taken] == [True]
    made = director("human", takeover=takeover)  # without a monitor: from the recovery point
    rows, _ = run_alone(made, [0, 0])
    assert said(rows, 0) == [5, 5]
    assert takeover.taken[-1]["over"], "a trial that ends while a person drives lets go of the slot"


@settings(max_examples=30, deadline=None)
@given(
    lives=st.lists(st.lists(st.integers(0, 9), min_size=12, max_size=12), min_size=1, max_size=5),
    mode=st.sampled_from(["monitor_reversion", "monitor_correction", "correction", "reversion", "direct"]),
)
def test_what_a_slot_does_depends_on_itself_alone(lives, mode):
    made = director(mode, monitor=At() if mode.startswith("monitor") else None)
    alone = [columns(run_alone(made, life)[0]) for life in lives]
    episodes = [made.start(7) for _ in lives]
    together = [[] for _ in lives]
    while any(len(rows) < 12 for rows in together):
        due = [i for i, rows in enumerate(together) if len(rows) < 12]
        chunks = made.act(
            [observation(lives[i][len(together[i])]) for i in due],
            ["go"] * len(due),
            [episodes[i] for i in due],
        )
        for i, chunk in zip(due, chunks, strict=True):
            together[i] += turns(chunk)
    for expected, rows in zip(alone, together, strict=True):
        np.testing.assert_array_equal(columns(rows[:12]), expected)


def columns(rows):
    """(n, A + 4): turns with their columns, without the clock's."""
    return np.concatenate([append_columns(r, 3) for r in rows])[:, :-1]


def test_a_member_that_raises_costs_its_slot_alone():
    made = director("direct")
    episodes = [made.start(1), made.start(2)]
    good, bad = made.act([observation(0.0), observation(0.0, bad=True)], ["go"] * 2, episodes)
    assert good.actions.shape == (4, 3)
    assert isinstance(bad, PolicyError)
    assert "base" in str(bad)
