"""LeRobot's evaluation loop in miniature, without LeRobot: what the vector env's properties are tested
under."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.session import SimulatorSpec
from lerobot_roborecover.evaluation.vector_env import create_recovery_envs
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.policies.interventions.options import InterventionFacts
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.workers.messages import SlotConfig


def push_policy(observation: dict) -> np.ndarray:
    """(B, 2) deterministic actions: go around the puck, get behind it, push it at the goal; often too
    slow."""
    state = observation["environment_state"]
    mass, puck, goal = state[:, 0:2], state[:, 2:4], state[:, 4:6]
    toward = goal - puck
    toward = toward / np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-6)
    gap = mass - puck
    along = (gap * toward).sum(1, keepdims=True)
    side = np.linalg.norm(gap - along * toward, axis=1, keepdims=True)
    across = np.stack([-toward[:, 1], toward[:, 0]], 1)
    sign = np.where((gap * across).sum(1, keepdims=True) < 0, -1.0, 1.0)
    around = puck + across * sign * 0.13 - 0.05 * toward
    target = np.where(along > -0.04, around, puck - 0.11 * toward)
    target = np.where((along < 0) & (side < 0.03), goal, target)
    return (8.0 * (target - mass)).astype(np.float32)


def evaluate(
    dataset: Path,
    log: Path,
    *,
    trials: int,
    batch: int,
    workers: bool = False,
    seed: int = 1000,
    stop_after_batches: int | None = None,
    policy=push_policy,
    reverse: bool = False,
    n_known: bool = True,
    platform: str = "fake",
    simulator: dict | None = None,
    spec: SimulatorSpec | None = None,
    rollback_steps: int = 0,
    **options,
) -> list[TrialRow]:
    """Runs every scenario as `lerobot-eval` would, and returns the log's rows."""
    rolls_back = InterventionFacts("reversion", rollback_steps, {"base": "push"}) if rollback_steps else None
    envs = create_recovery_envs(
        RecoveryOptions(scenarios=str(dataset), trial_log=str(log), **options),
        spec or SimulatorSpec(SlotConfig(platform, simulator or {}), {}, None),
        n_envs=batch,
        workers=workers,
        facts=PolicyMetadata(policy="push", n_episodes=trials if n_known else None, intervention=rolls_back),
    )
    flat = [env for group in envs.values() for env in group.values()]
    done_batches = 0
    try:
        for env in reversed(flat) if reverse else flat:
            for index in range(-(-trials // batch)):
                if stop_after_batches is not None and done_batches == stop_after_batches:
                    return read_trial_log(log)
                seeds = [seed + index * batch + i for i in range(batch)]
                observation, _ = env.reset(seed=seeds, options={"lerobot_new_rollout": True})
                done = np.zeros(batch, bool)
                for _ in range(env.call("_max_episode_steps")[0]):
                    observation, _, terminated, truncated, _ = env.step(policy(observation))
                    done |= terminated | truncated
                    if done.all():
                        break
                assert done.all()
                done_batches += 1
    finally:
        for env in flat:
            env.close()
    return read_trial_log(log)


def outcomes(rows: list[TrialRow]) -> dict[tuple, tuple]:
    """What must not depend on how a trial was run: outcome, steps and every executed action, by trial."""
    return {
        (r.scenario_id, r.start, r.trial): (r.outcome, r.steps, r.actions_sha256, r.handoff_identical)
        for r in rows
    }
