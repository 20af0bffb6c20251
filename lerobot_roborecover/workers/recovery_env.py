"""One recovery scenario as a Gymnasium environment: reset hands off, step continues the original task.

This is both the door for notebooks (`gymnasium.make("roborecover/Libero-v0", scenario=...)`) and what a
worker process runs for the vector env. Imports neither LeRobot nor torch.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_roborecover.platforms import (
    Simulator,
    SimulatorError,
    make_simulator,
    platform_named,
    resolve_rewind_steps,
)
from lerobot_roborecover.platforms.simulator import ShowsProgress, advance
from lerobot_roborecover.replay.handoff import Handoff, SnapshotCache, hand_off
from lerobot_roborecover.replay.rollback import RollbackHistory
from lerobot_roborecover.scenario import Start, TrialStart
from lerobot_roborecover.workers.messages import RollbackReply


class HandoffError(RuntimeError):
    """The handoff was not faithful, or left nothing to recover from; the policy must not run."""


class RecoveryEnv(gym.Env):
    """A scenario from its handoff to success or to the task's horizon.

    Args:
        scenario: what to rebuild at every reset.
        start: `recovery`, `initial` or `reversion`.
        rewind_steps: steps before the recovery point, for `reversion`; None takes the paper's.
        handoff_check: compare the handoff with the scenario's fingerprint.
        simulator: one to drive; by default the scenario's platform's, made with `options` and closed with the
            env.
        cache: handoff snapshots to use and to fill; by default one of this env's own.
        control_mode: how actions after the handoff are read, for simulators that have more than one way.
        rollback_steps: how far back `rollback` should be fast; it works without.
        played: (n, A) actions that a reset executes after the handoff, in their own type.
        spent: new steps that count as taken after a reset.
        render_mode: only `rgb_array`.
        options: keyword options of the simulator.

    `info` of a reset holds `handoff` (a dict of `replay.Handoff`); `info` of a step holds `is_success`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - Gymnasium's, and no ClassVar

    def __init__(
        self,
        scenario: TrialStart,
        start: str = "recovery",
        rewind_steps: int | None = None,
        *,
        handoff_check: bool = True,
        simulator: Simulator | None = None,
        cache: SnapshotCache | None = None,
        control_mode: str | None = None,
        rollback_steps: int = 0,
        played: np.ndarray | None = None,
        spent: int = 0,
        render_mode: str = "rgb_array",
        **options: Any,
    ):
        self.scenario = scenario
        self._platform = platform_named(scenario.platform)
        self.render_mode = render_mode
        self._start = Start(start)
        self._rewind_steps = resolve_rewind_steps(scenario, rewind_steps)
        self._check = handoff_check
        self._owns_simulator = simulator is None
        self._simulator = simulator or make_simulator(scenario.platform, **options)
        self._cache = cache if cache is not None else SnapshotCache()
        self._control_mode = control_mode
        self._rollback_steps = rollback_steps
        self._played, self._spent = played, spent
        self._history: RollbackHistory | None = None
        self.metadata = {**self.metadata, "render_fps": int(self._simulator.control_hz)}
        self.observation_space = self._simulator.observation_space
        self.action_space = self._platform.action_space(self._simulator.action_dim)
        self.handoff: Handoff | None = None
        self._steps = self._undone = 0

    @property
    def simulator(self) -> Simulator:
        """The simulator underneath, for privileged reads."""
        return self._simulator

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Rebuilds the handoff. The scenario fixes its own reset: `seed` changes nothing in the
        simulation."""
        super().reset(seed=seed)
        self._steps, self._undone = self._spent, 0
        self.handoff = hand_off(
            self._simulator,
            self.scenario,
            self._start,
            rewind_steps=self._rewind_steps,
            check=self._check,
            cache=self._cache,
        )
        self._history = RollbackHistory(
            self._simulator,
            self.scenario.rollout,
            self.handoff.step,
            keep=self._rollback_steps,
            cache=self._cache,
            control_mode=self._control_mode,
        )
        if self._played is not None and self.handoff.problem is None:
            advance(self._history, self._played)
        return self._simulator.observe(), {"is_success": False, "handoff": asdict(self.handoff)}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """One new step of the original task; success is the task's own predicate.

        Raises:
            HandoffError: the handoff had a problem, so there is no trial to step.
        """
        success = self.advance(action)
        observation = self._simulator.observe()
        return (
            observation,
            float(success),
            success,
            self.out_of_steps and not success,
            {"is_success": success},
        )

    @property
    def out_of_steps(self) -> bool:
        """Whether the task's horizon is used up, and what rollbacks undid on top of it
        (docs/interventions.md, "How steps count")."""
        return self._steps >= self.scenario.task.horizon + self._undone

    def advance(self, action: np.ndarray) -> bool:
        """The step without the observation; returns the predicate."""
        history = self._running()
        history.step(np.asarray(action))
        self._steps += 1
        return self._simulator.succeeded()

    def progress(self) -> float | None:
        """How much of the task is done, from 0 to 1; None where the simulator does not tell."""
        return self._simulator.progress() if isinstance(self._simulator, ShowsProgress) else None

    def rollback(self, steps: int) -> RollbackReply:
        """Puts the simulation back to the exact state that it had some steps ago.

        Args:
            steps: how many, the prefix included; limited to what there is since the task's start.

        Raises:
            SimulatorError: the state could not be had again.
        """
        history = self._running()
        began = time.perf_counter()
        result = history.roll_back(steps)
        self._undone += result.undone
        solved = self._simulator.succeeded()
        observation = self._simulator.observe()
        seconds = time.perf_counter() - began
        return RollbackReply(
            **asdict(result),
            observation=observation,
            seconds=seconds,
            solved=solved,
            progress=self.progress(),
        )

    def _running(self) -> RollbackHistory:
        if self.handoff is None or self._history is None:
            raise SimulatorError("step before reset")
        if self.handoff.problem is not None:
            raise HandoffError(f"{self.scenario.id}: {self.handoff.problem.value}: {self.handoff.reason}")
        return self._history

    def render(self) -> np.ndarray:
        """(H, W, 3) uint8 upright picture after the last step or reset."""
        return self._simulator.render()

    def close(self) -> None:
        """Closes the simulator, if this env made it."""
        if self._owns_simulator:
            self._simulator.close()


def make_env(platform: str, scenario: TrialStart | None = None, **kwargs: Any) -> RecoveryEnv:
    """Entry point of `roborecover/<Platform>-v0`.

    Args:
        platform: the scenario's.
        scenario: what to rebuild at every reset.
        kwargs: of `RecoveryEnv`.

    Raises:
        ValueError: there is no scenario, or it is of another platform.
    """
    if scenario is None:
        raise ValueError(
            f"give a scenario: gymnasium.make('roborecover/{platform.capitalize()}-v0', "
            f"scenario=load_scenarios('{platform_named(platform).default_scenarios or 'DATASET'}')[0])"
        )
    if platform not in (scenario.platform, platform_named(scenario.platform).env_name):
        raise ValueError(f"scenario {scenario.id} is of platform {scenario.platform!r}, not {platform!r}")
    return RecoveryEnv(scenario, **kwargs)
