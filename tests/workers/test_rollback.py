"""A rollback gives the exact state of some steps ago, on every simulator, and its steps are counted."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lerobot_roborecover.evaluation.intervention_record import InterventionRecord
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.policies.interventions.control_columns import (
    SIGNATURE,
    WIDTH,
    append_columns,
    strip_columns,
)
from lerobot_roborecover.policies.runner import Act, Controller, InterventionMark, Rollback
from lerobot_roborecover.scenario import Outcome
from lerobot_roborecover.workers.recovery_env import RecoveryEnv
from tests.support.factories import fake_dataset, fake_scenario
from tests.support.loop import evaluate, outcomes, push_policy


def recount(row: TrialRow) -> tuple[bool, int]:
    """Success and steps of a trial where steps that were undone do not count.

    A row's own `success` and `steps` count them, as the paper's text reads.
    """
    rollbacks = [e for e in row.interventions if isinstance(e, dict) and e.get("kind") == "rollback"]
    undone = sum(e.get("undone", 0) for e in rollbacks)
    extra = sum(e.get("extra_steps", 0) for e in rollbacks)
    solved = row.success or any(e.get("solved_in_extra", False) for e in rollbacks)
    return solved, row.steps + extra - undone


class InexactSimulator:
    """The fake simulator, but its snapshots are not to be trusted; as SAPIEN's."""

    def __init__(self):
        self._inner = make_simulator("fake")

    def __getattr__(self, name):
        return getattr(self._inner, name)

    snapshot_is_exact = False


def states_along(env: RecoveryEnv, actions: np.ndarray) -> list[str]:
    """State hash at the handoff and after each action."""
    env.reset()
    states = [env.simulator.state_sha256()]
    for action in actions:
        env.advance(action)
        states.append(env.simulator.state_sha256())
    return states


@settings(max_examples=25, deadline=None)
@given(
    taken=st.integers(0, 25),
    back=st.integers(0, 60),
    keep=st.sampled_from([0, 3, 60]),
    exact=st.booleans(),
    again=st.integers(0, 6),
)
@example(taken=4, back=1, keep=3, exact=True, again=4)  # the second goes further than snapshots are kept
@example(taken=20, back=3, keep=3, exact=True, again=0)
def test_the_state_of_k_steps_ago_on_the_fake_simulator(taken, back, keep, exact, again):
    scenario = fake_scenario(1, steps=14, horizon=60)
    simulator = make_simulator("fake") if exact else InexactSimulator()
    env = RecoveryEnv(scenario, simulator=simulator, rollback_steps=keep)
    rng = np.random.default_rng(taken)
    actions = rng.uniform(-1, 1, (taken, 2)).astype(np.float32)
    fresh = states_along(env, actions)
    prefix = states_along(
        RecoveryEnv(scenario, "initial", simulator=make_simulator("fake")), scenario.prefix[2:]
    )
    all_states = prefix[:-1] + fresh  # after the two settling actions, the start of an initial-state trial
    reached = len(prefix) - 1
    # Where snapshots are from: before each of the last keep + 1 steps. What was undone has none.
    kept = deque(maxlen=keep + 1 if exact and keep else 0)
    env.reset()
    for action in actions:
        env.advance(action)
        kept.append(reached)
        reached += 1
    for k in (back, again):  # a second rollback continues from where the first one went
        result = env.rollback(k)
        assert result.distance == min(k, reached)
        reached -= result.distance
        assert env.simulator.state_sha256() == all_states[reached]
        near = result.distance == 0 or reached - 1 in kept  # that step is taken again
        assert result.method == ("snapshot" if near else "replay")
        while kept and kept[-1] >= reached:
            kept.pop()
        follow = rng.uniform(-1, 1, (again, 2))
        for action in follow:
            env.advance(action)
            kept.append(reached)
            all_states[reached + 1 :] = [env.simulator.state_sha256()]
            reached += 1


@pytest.mark.metaworld
@pytest.mark.parametrize("keep", [0, 40])
def test_the_state_and_the_future_of_k_steps_ago_on_meta_world(keep):
    from lerobot_roborecover.datasets import load_scenarios

    simulator = make_simulator("metaworld", obs_type="state")
    scenario = load_scenarios("metaworld_starter")[0]
    env = RecoveryEnv(scenario, simulator=simulator, rollback_steps=keep)
    check_real(env, taken=25, backs=(7, 24, 40))
    env.close()
    simulator.close()


@pytest.mark.nightly
@pytest.mark.libero
def test_the_state_and_the_future_of_k_steps_ago_on_libero():
    from lerobot_roborecover.datasets import load_scenarios

    simulator = make_simulator("libero", obs_type="state")
    scenario = load_scenarios("libero_starter")[0]
    env = RecoveryEnv(scenario, simulator=simulator, rollback_steps=12)
    check_real(env, taken=10, backs=(4, 12))
    simulator.close()


def check_real(env: RecoveryEnv, taken: int, backs: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    width = env.simulator.action_dim
    actions = rng.uniform(-1, 1, (taken, width)).astype(np.float32)
    states = states_along(env, actions)
    for back in backs:
        env.reset()
        for action in actions:
            env.advance(action)
        result = env.rollback(back)
        assert (result.distance, result.undone) == (back, min(back, taken))
        if back <= taken:
            assert env.simulator.state_sha256() == states[taken - back]
            for action, state in zip(actions[taken - back :], states[taken - back + 1 :], strict=True):
                env.advance(action)
                assert env.simulator.state_sha256() == state
        else:  # into the prefix: the state of a start that many steps before the recovery point
            reached = env.simulator.state_sha256()
            earlier = RecoveryEnv(
                env.scenario, "reversion", rewind_steps=back - taken, simulator=env.simulator
            )
            observation, _ = earlier.reset()
            assert earlier.simulator.state_sha256() == reached
            assert data_equivalence(observation, result.observation, exact=True)


def test_decisions_survive_float32_and_nothing_else_is_read_as_one():
    mark = InterventionMark(Controller.CORRECTION, True, 0.75, 0.5)
    for steps in (None, 1, 60):
        assert strip_columns(append_columns(Rollback(steps, mark), 4), 4) == [Rollback(steps, mark)]
    rows = append_columns(Act(np.ones((3, 4), np.float32), mark), 4)
    decisions = strip_columns(rows, 4)
    assert [d.actions.tolist() for d in decisions] == [[[1.0] * 4]] * 3
    assert decisions[0].mark == mark
    assert [d.mark.asked for d in decisions] == [True, False, False]
    assert {d.mark.controller for d in decisions} == {Controller.CORRECTION}
    (unread,) = strip_columns(append_columns(Act(np.zeros((1, 2)), InterventionMark(asked=True)), 2), 2)
    assert unread.mark.asked
    assert np.isnan(unread.mark.score)
    below = np.array([[0.0, 0.0, SIGNATURE, -2, 0, -1, 0]], np.float32)
    for plain, width in ((np.zeros((2, 4 + WIDTH), np.float32), 4), (rows[:, :4], 4), (below, 2)):
        assert [d.mark for d in strip_columns(plain, width)] == [None] * len(plain)
        assert np.array_equal(np.concatenate([d.actions for d in strip_columns(plain, width)]), plain)


class Rewinds:
    """The deterministic test policy, which goes back at chosen steps of every trial."""

    def __init__(self, at: int, steps: int):
        self._at, self._steps, self._turn = at, steps, 0

    def __call__(self, observation):
        actions = push_policy(observation)
        go_back = self._turn == self._at
        self._turn += 1
        return attach_all(actions, self._steps if go_back else 0)


def attach_all(actions: np.ndarray, rollback: int = 0) -> np.ndarray:
    """Rows of LeRobot's loop, one a slot: actions, or rollbacks by this many steps."""
    decisions = [Rollback(rollback) if rollback else Act(a[None], InterventionMark()) for a in actions]
    return np.concatenate([append_columns(d, actions.shape[1]) for d in decisions])


def rolling_rows(dataset, log, at: int, steps: int, batch: int = 1):
    """One trial of each scenario under `Rewinds`, which starts anew with every batch."""
    rows = []
    for index, scenario in enumerate(sorted(dataset.iterdir())):
        rows += evaluate(
            scenario, log.with_name(f"{log.stem}{index}.jsonl"), trials=batch, batch=batch,
            policy=Rewinds(at, steps), rollback_steps=steps,
        )  # fmt: skip
    return rows


@pytest.fixture(scope="module")
def singles(tmp_path_factory):
    """A folder of datasets with one scenario each."""
    return write_singles(tmp_path_factory.mktemp("singles"), horizon=45)


def write_singles(root, horizon: int):
    from lerobot_roborecover.datasets import write_scenarios

    for index in range(4):
        write_scenarios(root / f"{index}", [fake_scenario(index, horizon=horizon)], description="one")
    return root


def test_going_back_at_the_recovery_point_is_reversion(singles, tmp_path):
    rolled = rolling_rows(singles, tmp_path / "a.jsonl", at=0, steps=6)
    started = []
    for index, scenario in enumerate(sorted(singles.iterdir())):
        log = tmp_path / f"s{index}.jsonl"
        started += evaluate(scenario, log, trials=1, batch=1, start="reversion", rewind_steps=6)
    assert [(r.outcome, r.steps, r.actions_sha256) for r in rolled] == [
        (r.outcome, r.steps, r.actions_sha256) for r in started
    ]
    for row in rolled:
        (entry,) = row.interventions
        assert {k: entry[k] for k in ("kind", "step", "distance", "undone")} == {
            "kind": "rollback", "step": 0, "distance": 6, "undone": 0,
        }  # fmt: skip
        assert recount(row) == (row.success, row.steps)


def test_undone_steps_count_and_both_readings_are_in_the_row(singles, tmp_path):
    rows = rolling_rows(singles, tmp_path / "a.jsonl", at=20, steps=15)
    assert {r.outcome for r in rows} == {"success", "horizon"}, "the test needs both"
    # Two steps less than a success takes with what was undone: solved in the steps given back.
    rows += rolling_rows(write_singles(tmp_path / "late", horizon=38), tmp_path / "b.jsonl", at=20, steps=15)
    for row in rows:
        (entry,) = row.interventions
        assert (entry["step"], entry["undone"]) == (20, 15)
        assert row.steps <= row.horizon
        solved, steps = recount(row)
        if row.success:
            assert (solved, steps) == (True, row.steps - 15)
        else:
            assert row.steps == row.horizon
            assert solved == entry["solved_in_extra"]
            assert solved or entry["extra_steps"] == 15
    extra = [r for r in rows if r.interventions[0]["solved_in_extra"]]
    assert extra, "the test needs these, too"
    assert all(not r.success and recount(r)[0] for r in extra)


@pytest.mark.parametrize(("solved_at", "expected"), [(45, "success"), (46, "horizon"), (60, "horizon")])
def test_success_in_the_extra_steps_counts_under_one_reading_alone(solved_at, expected):
    from lerobot_roborecover.workers.messages import RollbackReply

    record = InterventionRecord()
    record.note(Rollback(15), InterventionMark(), 20)
    record.rolled_back(RollbackReply(15, 15, "snapshot", {}, 0.0, False))
    assert record.undone == 15
    record.solved()
    outcome, steps = record.verdict(solved_at, 45)
    assert (outcome, steps) == (Outcome(expected), min(solved_at, 45))
    (entry,) = record.entries()
    assert entry["solved_in_extra"] is (expected == "horizon")
    assert entry["extra_steps"] == max(solved_at - 45, 0)


def test_a_rollback_in_one_slot_leaves_the_others_alone(singles, tmp_path):
    """Slot 1 of three goes back; slots 0 and 2 do what they do alone."""
    folder = sorted(singles.iterdir())[0]
    alone = evaluate(folder, tmp_path / "alone.jsonl", trials=3, batch=3)
    turn = iter(range(10_000))

    def one_of_three(observation):
        rows = attach_all(push_policy(observation))
        if next(turn) == 9:
            rows[1] = append_columns(Rollback(5), 2)[0]
        return rows

    mixed = evaluate(
        folder, tmp_path / "mixed.jsonl", trials=3, batch=3, policy=one_of_three, rollback_steps=5
    )
    kept = [k for k in outcomes(alone) if k[2] != 1]
    assert {k: outcomes(mixed)[k] for k in kept} == {k: outcomes(alone)[k] for k in kept}
    by_trial = {r.trial: r for r in mixed}
    assert [bool(by_trial[k].interventions) for k in range(3)] == [False, True, False]


def test_an_interrupted_run_with_rollbacks_resumes(tmp_path):
    dataset = fake_dataset(tmp_path / "set", 3)

    class EachTrial:
        """Goes back at the fifth turn of every trial: the handoff observation starts the count."""

        turns = 0

        def __call__(self, observation):
            begins = tuple(observation["environment_state"][0]) in starts
            self.turns = 0 if begins else self.turns + 1
            return attach_all(push_policy(observation), 3 if self.turns == 5 else 0)

    starts = {tuple(RecoveryEnv(fake_scenario(i)).reset()[0]["environment_state"]) for i in range(3)}
    whole = evaluate(
        dataset, tmp_path / "whole.jsonl", trials=2, batch=1, policy=EachTrial(), rollback_steps=3
    )
    part = {"trials": 2, "batch": 1, "rollback_steps": 3}
    evaluate(dataset, tmp_path / "part.jsonl", policy=EachTrial(), stop_after_batches=2, **part)
    resumed = evaluate(dataset, tmp_path / "part.jsonl", policy=EachTrial(), **part)
    assert outcomes(resumed) == outcomes(whole)
    assert all(len(r.interventions) == 1 for r in resumed)
    assert not any(a == b for a, b in pairwise(r.actions_sha256 for r in whole if r.trial == 0))
