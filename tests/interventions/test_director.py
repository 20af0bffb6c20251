"""Who acts in a slot, step by step: the composite policy's director alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.policies.runner import PolicyError
from lerobot_roborecover.workers.control_columns import BY_RULE, Controller, strip_columns
from tests.support.small_interventions import CountingMember, ScriptedController, observation

pytestmark = pytest.mark.lerobot


def director(mode, *, monitor=None, takeover=None, correction_steps=5):
    from lerobot_roborecover.policies.interventions.controller import InterventionController

    members = {Controller.BASE: CountingMember(1.0, 4), Controller.CORRECTION: CountingMember(2.0, 3)}
    return InterventionController(
        members, mode, monitor=monitor, takeover=takeover, correction_steps=correction_steps
    )


def run_alone(made, values, bad=()):
    """Rows of one slot that sees these values, one a step; whole chunks are executed blindly."""
    episode = made.start(7)
    rows = []
    while len(rows) < len(values):
        step = len(rows)
        (chunk,) = made.act([observation(values[step], step in bad)], ["go"], [episode])
        if isinstance(chunk, PolicyError):
            return rows, chunk
        rows += list(chunk)
    made.finish(episode)
    return rows[: len(values)], None


class At:
    """A monitor that triggers wherever the observation is 9, and cannot be read where it is 8."""

    max_batch = 2

    def __init__(self):
        self.input_features = {}
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
    who_and_step = [(r[0], r[1]) for r in rows]
    assert who_and_step == [(2, 0), (2, 1), (2, 2), (2, 3), (2, 4), (1, 0), (1, 1), (1, 2), (1, 3), (1, 4)]
    _, directives = strip_columns(np.stack(rows), 3)
    assert [d.controller for d in directives] == [Controller.CORRECTION] * 5 + [Controller.BASE] * 5
    assert not any(d.asked for d in directives)
    for member in made.members.values():
        assert member.begun == member.finished


def test_the_monitor_is_asked_every_step_until_it_triggers_once():
    monitor = At()
    made = director("monitor_correction", monitor=monitor)
    values = [1, 8, 2, 9, 9, 9, 9, 9, 9, 9]
    rows, _ = run_alone(made, values)
    assert monitor.asked == [1, 8, 2, 9]
    _, directives = strip_columns(np.stack(rows), 3)
    assert [d.asked for d in directives] == [True] * 4 + [False] * 6
    assert [r[0] for r in rows] == [1, 1, 1, 2, 2, 2, 2, 2, 1, 1]
    # The base's chunk of four is cut after three; when it is back, it begins anew.
    assert [r[1] for r in rows] == [0, 1, 2, 0, 1, 2, 3, 4, 0, 1]
    assert directives[3].score == pytest.approx(0.9)
    assert np.isnan(directives[1].score)


def test_a_monitored_rollback_takes_a_turn_and_flushes_the_queue():
    made = director("monitor_reversion", monitor=At())
    rows, _ = run_alone(made, [1, 2, 9, 3, 3, 3])
    _, directives = strip_columns(np.stack(rows), 3)
    assert [d.rollback for d in directives] == [0, 0, BY_RULE, 0, 0, 0]
    assert [r[1] for r in rows] == [0, 1, 0, 0, 1, 2]
    assert (rows[2][:3] == 0).all()


def test_a_person_takes_over_and_hands_back():
    takeover = ScriptedController(3)
    takeover.act = lambda slot, seen: (
        None if not slot["left"] else (slot.update(left=slot["left"] - 1), np.full(3, 5.0, np.float32))[1]
    )
    made = director("human", monitor=At(), takeover=takeover)
    rows, _ = run_alone(made, [1, 9, 0, 0, 0, 0, 0])
    assert [r[0] for r in rows] == [1, 5, 5, 5, 1, 1, 1]
    assert [s["over"] for s in takeover.taken] == [True]
    made = director("human", takeover=takeover)  # without a monitor: from the recovery point
    rows, _ = run_alone(made, [0, 0])
    assert [r[0] for r in rows] == [5, 5]
    assert takeover.taken[-1]["over"], "a trial that ends while a person drives lets go of the slot"


@settings(max_examples=30, deadline=None)
@given(
    lives=st.lists(st.lists(st.integers(0, 9), min_size=12, max_size=12), min_size=1, max_size=5),
    mode=st.sampled_from(["monitor_reversion", "monitor_correction", "correction", "reversion", "direct"]),
)
def test_what_a_slot_does_depends_on_itself_alone(lives, mode):
    made = director(mode, monitor=At() if mode.startswith("monitor") else None)
    alone = [np.stack(run_alone(made, life)[0])[:, :-1] for life in lives]  # without the clock's column
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
            together[i] += list(chunk)
    for expected, rows in zip(alone, together, strict=True):
        np.testing.assert_array_equal(np.stack(rows)[:12, :-1], expected)


def test_a_member_that_raises_costs_its_slot_alone():
    made = director("direct")
    episodes = [made.start(1), made.start(2)]
    good, bad = made.act([observation(0.0), observation(0.0, bad=True)], ["go"] * 2, episodes)
    assert good.shape == (4, 8)
    assert isinstance(bad, PolicyError)
    assert "base" in str(bad)
