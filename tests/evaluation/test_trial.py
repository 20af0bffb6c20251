"""A trial's life: every transition alone, and that it is one life however a loop cuts it into chunks."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lerobot_roborecover.evaluation.trial import SOLVED_THERE, Trial, TrialState
from lerobot_roborecover.logs.row import EvalProtocol
from lerobot_roborecover.policies.runner import Act, Controller, InterventionMark, Rollback
from lerobot_roborecover.replay.handoff import Handoff
from lerobot_roborecover.scenario import Outcome
from lerobot_roborecover.workers.messages import (
    ActResult,
    EpisodeStart,
    RollbackReply,
    SlotFailure,
)
from tests.support.factories import fake_scenario

HORIZON = 12
SCENARIO = fake_scenario(0, horizon=HORIZON)
PROTOCOL = EvalProtocol("recovery", 0, "p", 7, 4)
HANDOFF = Handoff(10, 0.1, False, "", 0.2, 0.3, True, None)
BAD = np.array([np.nan, 0.0])


def new() -> Trial:
    return Trial(SCENARIO, 3, PROTOCOL, action_width=2)


def handed_off(handoff: Handoff = HANDOFF) -> Trial:
    trial = new()
    trial.begin()
    trial.on_reply(EpisodeStart({"state": 0}, handoff))
    return trial


def asked() -> Trial:
    trial = handed_off()
    trial.ask()
    return trial


def acting(chunk: int = 1) -> Trial:
    trial = asked()
    trial.on_actions(np.zeros((chunk, 2)), seconds=0.5)
    return trial


def row(trial: Trial):
    return trial.row(dataset="d", dataset_revision=None, noise="per_trial", batch_size=1)


def test_a_trial_that_succeeds():
    trial = new()
    assert trial.state is TrialState.NEW
    assert trial.begin().scenario is SCENARIO
    assert trial.state is TrialState.HANDING_OFF
    assert trial.in_simulator
    trial.on_reply(EpisodeStart({"state": 0}, HANDOFF))
    assert trial.state is TrialState.WAITING
    assert not trial.in_simulator
    assert trial.ask() == {"state": 0}
    assert trial.state is TrialState.ASKED
    move = trial.on_actions(np.ones((2, 2)), seconds=0.5)
    assert isinstance(move, Act)
    assert move.actions.shape == (2, 2)
    assert trial.state is TrialState.ACTING
    trial.on_reply(ActResult({"state": 2}, 2, False, False, 0.25))
    assert trial.ask() == {"state": 2}
    trial.on_actions(np.ones((1, 2)), seconds=0.5)
    trial.on_reply(ActResult({"state": 3}, 1, True, True, 0.25))
    assert trial.over
    assert trial.success
    assert trial.outcome is Outcome.SUCCESS
    made = row(trial)
    assert (made.steps, made.sim_s, made.policy_s, made.trial) == (3, 0.5, 1.0, 3)
    assert (made.handoff_step, made.handoff_object_error_mm, made.handoff_identical) == (10, 0.3, True)


def test_out_of_steps():
    trial = handed_off()
    for k in range(HORIZON):
        assert not trial.over
        trial.ask()
        trial.on_actions(np.zeros((1, 2)), seconds=0.0)
        trial.on_reply(ActResult({}, 1, False, k == HORIZON - 1, 0.0))
    assert (trial.outcome, trial.steps, trial.success) == (Outcome.HORIZON, HORIZON, False)


def test_an_unfaithful_handoff_never_reaches_the_policy():
    problem = Handoff(10, 0.1, False, "", 5.0, 0.0, False, Outcome.STATE_MISMATCH, "5 mm off")
    trial = handed_off(problem)
    assert (trial.outcome, trial.reason, trial.steps) == (Outcome.STATE_MISMATCH, "5 mm off", 0)
    with pytest.raises(RuntimeError, match="cannot become asked"):
        trial.ask()


@pytest.mark.parametrize(
    ("kind", "outcome"),
    [("raised", Outcome.SIM_ERROR), ("died", Outcome.SIM_ERROR), ("hung", Outcome.TIMEOUT)],
)
def test_a_simulators_failure(kind, outcome):
    early = new()
    early.begin()
    early.on_reply(SlotFailure(kind, "broke"))
    assert (early.outcome, early.reason) == (outcome, "at the handoff: broke")
    late = acting()
    late.on_reply(SlotFailure(kind, "broke"))
    assert (late.outcome, late.reason, late.steps) == (outcome, "at step 0: broke", 0)
    assert row(late).actions_sha256 == row(early).actions_sha256, "nothing is known to have been executed"


def test_a_bad_action_is_not_sent():
    trial = asked()
    assert trial.on_actions(np.stack([BAD, BAD]), seconds=0.1) is None
    assert trial.outcome is Outcome.POLICY_ERROR
    assert "non-finite" in trial.reason
    later = asked()
    move = later.on_actions(np.stack([np.zeros(2), BAD]), seconds=0.1)
    assert len(move.actions) == 1
    later.on_reply(ActResult({}, 1, False, False, 0.0))
    assert later.outcome is Outcome.POLICY_ERROR
    assert later.steps == 1
    wide = asked()
    assert wide.on_actions(np.zeros((1, 3)), seconds=0.1) is None
    assert "(3,)" in wide.reason


def test_success_before_a_bad_action_is_success():
    trial = asked()
    trial.on_actions(np.stack([np.zeros(2), BAD]), seconds=0.1)
    trial.on_reply(ActResult(None, 1, True, True, 0.0))
    assert trial.outcome is Outcome.SUCCESS


def test_a_policy_that_raises():
    trial = asked()
    trial.on_policy_error("no CUDA", seconds=0.25)
    assert (trial.outcome, trial.reason) == (Outcome.POLICY_ERROR, "at step 0: no CUDA")
    assert row(trial).policy_s == 0.25


def test_going_back():
    trial = acting()
    trial.on_reply(ActResult({"state": 1}, 1, False, False, 0.0))
    trial.ask()
    assert trial.on_actions(Rollback(4), seconds=0.0) == Rollback(4)
    assert trial.state is TrialState.ROLLING_BACK
    trial.on_reply(RollbackReply(4, 1, "snapshot", {"state": -3}, 0.5, False))
    assert trial.state is TrialState.WAITING
    assert trial.observation == {"state": -3}
    trial.ask()
    trial.on_actions(np.zeros((1, 2)), seconds=0.0)
    trial.on_reply(ActResult({}, 1, True, True, 0.0))
    (told,) = row(trial).interventions
    assert (told["step"], told["distance"], told["undone"], trial.steps) == (1, 4, 1, 2)


def test_a_rollback_reaches_the_worker_as_a_number_of_steps():
    assert asked().on_actions(Rollback(None), seconds=0.0) == Rollback(30), "the paper's, for this platform"
    for steps in (0, -1):
        trial = asked()
        assert trial.on_actions(Rollback(steps), seconds=0.0) is None
        assert trial.outcome is Outcome.POLICY_ERROR
        assert f"rollback of {steps} steps" in trial.reason


def test_going_back_to_where_the_task_is_solved():
    trial = asked()
    trial.on_actions(Rollback(4), seconds=0.0)
    trial.on_reply(RollbackReply(4, 0, "snapshot", {}, 0.5, True))
    assert (trial.outcome, trial.reason) == (Outcome.SOLVED_BY_PREFIX, SOLVED_THERE)


def test_a_skipped_trial_has_no_row():
    trial = new()
    trial.skip(success=True, steps=5)
    assert (trial.over, trial.success, trial.steps, trial.outcome) == (True, True, 5, None)
    with pytest.raises(RuntimeError, match="no outcome"):
        row(trial)


STATES = {
    TrialState.NEW: new,
    TrialState.HANDING_OFF: lambda: (t := new(), t.begin())[0],
    TrialState.WAITING: handed_off,
    TrialState.ASKED: asked,
    TrialState.ACTING: acting,
    TrialState.ROLLING_BACK: lambda: (
        t := asked(), t.on_actions(Rollback(1), seconds=0)
    )[0],
    TrialState.OVER: lambda: (t := new(), t.skip())[0],
}  # fmt: skip
EVENTS = {
    "begin": (lambda t: t.begin(), {TrialState.NEW}),
    "skip": (lambda t: t.skip(), {TrialState.NEW}),
    "ask": (lambda t: t.ask(), {TrialState.WAITING}),
    "decide": (lambda t: t.on_actions(np.zeros((1, 2)), seconds=0.0), {TrialState.ASKED}),
    "refused": (lambda t: t.on_policy_error("x", seconds=0.0), {TrialState.ASKED}),
    "start": (lambda t: t.on_reply(EpisodeStart({}, HANDOFF)), {TrialState.HANDING_OFF}),
    "stepped": (lambda t: t.on_reply(ActResult({}, 1, False, False, 0.0)), {TrialState.ACTING}),
    "acted": (lambda t: t.on_reply(ActResult({}, 1, False, False, 0.0)), {TrialState.ACTING}),
    "went back": (
        lambda t: t.on_reply(RollbackReply(1, 0, "replay", {}, 0.0, False)),
        {TrialState.ROLLING_BACK},
    ),
    "broke": (
        lambda t: t.on_reply(SlotFailure("died", "x")),
        {TrialState.HANDING_OFF, TrialState.ACTING, TrialState.ROLLING_BACK},
    ),
    "fail": (lambda t: t.fail(Outcome.SIM_ERROR, "x"), set(TrialState) - {TrialState.OVER}),
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("event", EVENTS)
def test_an_event_in_a_state_where_it_cannot_happen_changes_nothing(state, event):
    trial, (happens, allowed) = STATES[state](), EVENTS[event]
    assert trial.state is state
    if state in allowed:
        happens(trial)
        return
    with pytest.raises(RuntimeError, match=f"{state}\\) cannot become"):
        happens(trial)
    assert trial.state is state


ACTION = st.sampled_from(["plain"] * 8 + ["solves", "bad"])
DECISION = st.one_of(
    st.tuples(st.just("act"), st.lists(ACTION, min_size=1, max_size=5), st.sampled_from(Controller)),
    st.tuples(st.just("back"), st.integers(1, 6), st.just(Controller.BASE)),
)


_FOUR = ("act", ["plain"] * 4, Controller.BASE)
_BACK = ("back", 1, Controller.BASE)
_REFUSED = ("act", ["plain"] * 4 + ["bad"], Controller.BASE)


@settings(max_examples=150, deadline=None)
@given(st.lists(DECISION, min_size=1, max_size=8))
@example([_FOUR, _BACK, _FOUR, _BACK, ("act", ["plain"], Controller.BASE), _REFUSED])
def test_a_chunk_counts_as_its_actions_one_by_one(decisions):
    whole, single = live(decisions, whole_chunks=True), live(decisions, whole_chunks=False)
    assert whole.state is single.state
    if whole.outcome is not None:
        rows = [asdict(row(t)) for t in (whole, single)]
        for made in rows:
            for timing in ("sim_s", "policy_s", "finished_at"):
                made.pop(timing)
        assert rows[0] == rows[1]
        assert rows[0]["steps"] <= HORIZON
        assert rows[0]["success"] == (whole.outcome is Outcome.SUCCESS)


def live(decisions, *, whole_chunks: bool) -> Trial:
    """A trial that lives through the decisions, its chunks executed whole or an action at a time."""
    trial, simulated, undone = handed_off(), 0, 0
    for kind, what, controller in decisions:
        if trial.over:
            break
        if kind == "back":
            trial.ask()
            trial.on_actions(Rollback(what), seconds=0.0)
            back = min(what, simulated - undone)
            undone += back
            trial.on_reply(RollbackReply(what, back, "replay", {}, 0.1, False))
            continue
        codes = {"plain": np.zeros(2), "solves": np.ones(2), "bad": BAD}
        chunk = np.stack([codes[code] for code in what])
        asked, silent = InterventionMark(controller, asked=True, score=0.5), InterventionMark(controller)
        for first in [0] if whole_chunks else range(len(chunk)):
            if trial.over:
                break
            trial.ask()
            part = chunk if whole_chunks else chunk[first : first + 1]
            move = trial.on_actions(Act(part, silent if first else asked), seconds=0.1)
            if move is None:
                break
            steps, solved = 0, False
            for action in move.actions:
                steps, simulated, solved = steps + 1, simulated + 1, bool(action[0])
                if solved or simulated >= HORIZON + undone:
                    break
            over = solved or simulated >= HORIZON + undone
            trial.on_reply(ActResult({}, steps, solved, over, 0.1))
    return trial
