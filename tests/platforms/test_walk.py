"""The one walker and the one recorder, on the fake simulator."""

from __future__ import annotations

from itertools import chain

import numpy as np
import pytest

from lerobot_roborecover.curation.rollout import record
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.platforms.simulator import advance, follow, iter_steps
from lerobot_roborecover.replay.recorder import PERTURBED, UNPERTURBED, Recorder
from lerobot_roborecover.scenario import Reset, Rollout, Task

TASK = Task("fake", "toy", "push-left", "push", 60)
ACTIONS = np.random.default_rng(3).uniform(-1, 1, (12, 2))
ROLLOUT = Rollout(TASK, Reset(seed=2, settle_steps=2), ACTIONS)


def states(simulator, steps):
    """Hash of each state of a walk."""
    return [simulator.state_sha256() for _ in steps]


def by_hand() -> list[str]:
    """What resetting and stepping give."""
    simulator = make_simulator("fake")
    simulator.reset(TASK, ROLLOUT.reset)
    found = [simulator.state_sha256()]
    for action in ACTIONS:
        simulator.step(action)
        found.append(simulator.state_sha256())
    return found


def test_a_walk_stands_at_every_state_once():
    simulator = make_simulator("fake")
    assert list(iter_steps(simulator, ROLLOUT)) == list(range(13))
    assert states(simulator, iter_steps(simulator, ROLLOUT)) == by_hand()
    assert states(simulator, iter_steps(simulator, ROLLOUT, 4)) == by_hand()[:5]
    advance(simulator, ACTIONS[4:])
    assert simulator.state_sha256() == by_hand()[-1]


def test_what_nobody_asks_for_is_not_executed():
    simulator = make_simulator("fake")
    for step in iter_steps(simulator, ROLLOUT):
        if step == 5:
            break
    assert simulator.state_sha256() == by_hand()[5]
    assert list(follow(simulator, ACTIONS[5:], 5)) == list(range(5, 13))


def test_each_action_keeps_its_type():
    class Typed:
        def __init__(self):
            self.seen = []

        def step(self, action):
            self.seen.append(action.dtype)

    simulator = Typed()
    advance(simulator, chain(ACTIONS[:2], ACTIONS[2:4].astype(np.float32)))
    assert simulator.seen == [np.float64] * 2 + [np.float32] * 2


def test_a_record_replays_and_says_what_happened():
    recorder = Recorder(make_simulator("fake"))
    recorder.reset(TASK, ROLLOUT.reset)
    for t, action in enumerate(ACTIONS):
        recorder.step(action, PERTURBED if t == 7 else UNPERTURBED)
    assert recorder.rollout.sha256() == ROLLOUT.sha256()
    steps = recorder.steps
    assert steps.perturbation.tolist() == [0] * 7 + [1] + [0] * 4
    assert steps.solved.shape == (13,)
    again = make_simulator("fake")
    for step in iter_steps(again, recorder.rollout):
        assert again.bodies() == steps.poses_at(step)
        assert again.succeeded() == steps.solved[step]


def test_steps_taken_back_are_not_in_the_record():
    simulator = make_simulator("fake")
    recorder = Recorder(simulator)
    recorder.reset(TASK, ROLLOUT.reset)
    advance(recorder, ACTIONS)
    recorder.cut(5)
    list(iter_steps(simulator, recorder.rollout))  # the simulator goes there as well
    advance(recorder, ACTIONS[5:])
    assert recorder.rollout.sha256() == ROLLOUT.sha256()
    assert len(recorder.bodies) == len(recorder.solved) == 13
    recorder.reset(TASK, Reset(seed=4))
    assert len(recorder) == 0
    assert recorder.rollout.actions.shape == (0, 2)


def test_a_driver_is_recorded_under_the_papers_perturbation():
    made = record(
        make_simulator("fake"), TASK, ROLLOUT.reset, ACTIONS.__getitem__, steps=6, settle_action=np.zeros(2),
        perturb=np.random.default_rng(1), perturbed_steps=4, stop_when_solved=False,
    )  # fmt: skip
    noise = np.random.default_rng(1)
    expected = [a + noise.uniform(-1, 1, 3)[:2] if t < 4 else a for t, a in enumerate(ACTIONS[:6])]
    assert np.array_equal(made.rollout.actions, [[0, 0], [0, 0], *expected])
    assert made.steps.perturbation.tolist() == [0, 0, 1, 1, 1, 1, 0, 0]
    with pytest.raises(ValueError, match="settle_action"):
        record(make_simulator("fake"), TASK, ROLLOUT.reset, ACTIONS.__getitem__, steps=1)
