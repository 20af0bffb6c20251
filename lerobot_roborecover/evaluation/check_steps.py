"""The simulator's part of `roborecover check-policy`: a handoff, and the policy's first steps after it."""

import statistics
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_roborecover.evaluation.session import EvalSession
from lerobot_roborecover.platforms import resolve_rewind_steps
from lerobot_roborecover.platforms.findings import Check, failure
from lerobot_roborecover.policies.action_checks import action_problem, chunk_problem
from lerobot_roborecover.policies.runner import PolicyError, PolicyRunner, Rollback, decision_of
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.workers.messages import (
    ActResult,
    EpisodeSpec,
    EpisodeStart,
    RollbackReply,
    SlotFailure,
)


@dataclass
class FirstSteps:
    """What the first steps in the simulator left."""

    observations: list[dict[str, Any]]
    """Raw, one before each step and one after the last."""
    actions: np.ndarray
    """(T, A), as executed."""
    infer_s: list[float]
    """Seconds of each inference, the first with whatever it compiles."""
    reset_s: float
    step_s: float
    """Of the simulator, observation included."""


def hand_off_scenario(run: EvalSession, scenario: Scenario) -> EpisodeStart | Check:
    """Hands a scenario off in the real simulator; what is wrong, where it cannot be."""
    slot = run.pool.slots(1)[0]
    protocol = run.protocol
    spec = EpisodeSpec(scenario, protocol.start, protocol.rewind_for(scenario), run.handoff_check)
    slot.send("reset", spec)
    reply = slot.receive()
    if isinstance(reply, SlotFailure):
        return failure(
            "simulator", reply.message, f"scenario {scenario.id} handed off",
            "'roborecover doctor' checks simulators and OpenGL",
        )  # fmt: skip
    assert isinstance(reply, EpisodeStart)
    if reply.handoff.problem is not None:
        return failure(
            "simulator", f"{reply.handoff.problem.value}: {reply.handoff.reason}",
            f"scenario {scenario.id} handed off within 2 mm",
            "the installed versions or assets differ from those the scenarios were recorded with",
        )  # fmt: skip
    return reply


def take_steps(
    host: PolicyRunner,
    run: EvalSession,
    scenario: Scenario,
    start: EpisodeStart,
    *,
    seed: int | None,
    steps: int,
) -> FirstSteps | Check:
    """A few steps, one action at a time, so that every observation is seen."""
    slot = run.pool.slots(1)[0]
    observations, actions, infer_s, step_s = [start.observation], [], [], []
    width = run.action_width(scenario)
    history = host.start(seed)
    try:
        while len(actions) < steps:
            began = time.perf_counter()
            (answer,) = host.act([observations[-1]], [scenario.task.instruction], [history])
            infer_s.append(time.perf_counter() - began)
            if isinstance(answer, PolicyError):
                return failure(
                    "actions", str(answer), "a chunk of actions",
                    "the policy cannot take what the env gives: see the inputs above, and the message",
                )  # fmt: skip
            decision = decision_of(answer)
            if isinstance(decision, Rollback):
                slot.send("rollback", resolve_rewind_steps(scenario, decision.steps))
                reply = slot.receive()
                if isinstance(reply, SlotFailure):
                    return failure(
                        "simulator", reply.message, "a rollback", "'roborecover doctor' checks simulators"
                    )
                assert isinstance(reply, RollbackReply)
                observations[-1] = reply.observation
                continue
            chunk = decision.actions
            if problem := chunk_problem(scenario, chunk, width):
                return _refused(problem, width)
            for action in chunk[: steps - len(actions)]:
                if problem := action_problem(scenario, action, width):
                    return _refused(problem, width)
                slot.send("act", action[None])
                reply = slot.receive()
                if isinstance(reply, SlotFailure):
                    return failure(
                        "simulator", reply.message, "a step", "'roborecover doctor' checks simulators"
                    )
                assert isinstance(reply, ActResult)
                actions.append(np.asarray(action, dtype=np.float64))
                step_s.append(reply.seconds)
                if reply.observation is None:  # the trial is over
                    break
                observations.append(reply.observation)
            else:
                continue
            break
        if len(infer_s) == 1 and len(observations) > 1:  # the first one alone tells little about speed
            began = time.perf_counter()
            host.act([observations[-1]], [scenario.task.instruction], [history])
            infer_s.append(time.perf_counter() - began)
    finally:
        host.finish(history)
    step = statistics.median(step_s)
    return FirstSteps(observations, np.stack(actions), infer_s, start.handoff.seconds, step)


def _refused(problem: str, width: int) -> Check:
    return failure(
        "actions", problem, f"{width} finite values",
        "such an action is never sent to the simulator; every trial would be a policy_error. Check the "
        "checkpoint's statistics and that it is for this robot",
    )  # fmt: skip
