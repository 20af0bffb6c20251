"""The slot server of a collection: records what a policy does, runs scripted experts, renders by replay."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from lerobot_roborecover.curation.collect.experts import make_controller
from lerobot_roborecover.curation.collect.record import (
    RecorderSettings,
    RecordingSimulator,
    RolloutOutcome,
    pack_record,
)
from lerobot_roborecover.curation.collect.starts import RolloutSpec
from lerobot_roborecover.platforms import Observation, Simulator
from lerobot_roborecover.platforms.simulator import advance, iter_steps
from lerobot_roborecover.platforms.starts import stream
from lerobot_roborecover.scenario import Outcome, Rollout, TrialStart
from lerobot_roborecover.workers.messages import ActResult, EpisodeSpec, EpisodeStart, InProgress, SlotConfig
from lerobot_roborecover.workers.worker import SlotServer

SERVER = f"{__name__}:CollectServer"
REPLY_EVERY_S = 5.0
"""How long a rollout or a rendering goes on before its slot gives a sign of life."""


@dataclass(frozen=True)
class VideoJob:
    """A rollout to be replayed and looked at."""

    rollout: Rollout
    bodies: tuple[str, ...]
    poses: np.ndarray
    """(bodies, T + 1, 7) as recorded, to compare with."""
    every: int = 1
    """Looked at before each so many-th action; what was seen stands for those in between."""


@dataclass(frozen=True)
class RenderedRollout:
    observations: list[Observation]
    """T raw observations, one before each action."""
    error_m: float
    """Largest distance of a body from where it was recorded, at any step."""


class CollectServer(SlotServer):
    """A slot that records; without settings it only renders.

    Args:
        config: `settings` are those of `RecorderSettings`.
    """

    def __init__(self, config: SlotConfig):
        super().__init__(config)
        self._settings = RecorderSettings(**config.settings) if config.settings else None
        self._recording: RecordingSimulator | None = None
        self._under_way: Iterator[tuple[RolloutOutcome, bytes] | RenderedRollout | None] = iter(())
        if self._settings is not None:
            self._recording = RecordingSimulator(self._simulator, self._settings)
            self._simulator = cast(Simulator, self._recording)  # by delegation

    def answer(self, command: str, argument: object = None) -> object:
        """Answers `roll_out` and `render` beside the usual commands."""
        if command not in ("roll_out", "render"):
            return super().answer(command, argument)
        if isinstance(argument, RolloutSpec):
            self._under_way = self._roll_out(argument)
        elif isinstance(argument, VideoJob):
            self._under_way = self._render_rollout(argument)
        # A watchdog that counted a whole rollout would take a slow machine for a hung simulator.
        began = time.monotonic()
        for result in self._under_way:
            if result is not None:
                return result
            if time.monotonic() - began > REPLY_EVERY_S:
                break
        return InProgress()

    def _reset(self, spec: EpisodeSpec) -> EpisodeStart:
        if self._recording is not None:
            assert isinstance(spec.scenario, RolloutSpec)
            self._recording.plan(spec.scenario)
        return super()._reset(spec)

    def _smoke(self, scenario: TrialStart) -> np.ndarray | None:
        if self._recording is not None and isinstance(scenario, RolloutSpec):
            self._recording.plan(scenario)
        return super()._smoke(scenario)

    def _act(self, actions: np.ndarray, *, observe: bool = False) -> ActResult:
        result = super()._act(actions, observe=observe)
        if self._recording is None or not result.over:
            return result
        return replace(result, attachment=pack_record(self._recording.record()))

    def _roll_out(self, planned: RolloutSpec) -> Iterator[tuple[RolloutOutcome, bytes] | None]:
        """A rollout; yields None after each step, and at last how it ended, and its record's file if it
        did."""
        assert self._recording is not None
        assert self._settings is not None
        simulator, task, reset = self._recording, planned.task, planned.reset
        simulator.plan(planned)
        simulator.reset(task, reset)
        advance(simulator, planned.prefix)
        if simulator.succeeded():
            reason = "the task's predicate holds before the first action"
            yield RolloutOutcome(planned.record_name, Outcome.SOLVED_BY_PREFIX.value, 0, reason), b""
            return
        rng = stream(self._settings.seed, "driver", task, reset, planned.trial)
        act = make_controller(self._settings.expert, simulator.inner, task, rng)
        for t in range(task.horizon):
            action = np.asarray(act(t), dtype=np.float64)
            if not np.isfinite(action).all():
                reason = f"the controller gave {action}"
                yield RolloutOutcome(planned.record_name, Outcome.POLICY_ERROR.value, t, reason), b""
                return
            simulator.step(action)
            if simulator.over:
                solved = simulator.succeeded()
                outcome = Outcome.SUCCESS if solved else Outcome.HORIZON
                ended = RolloutOutcome(planned.record_name, outcome.value, t + 1)
                yield ended, pack_record(simulator.record())
                return
            yield None

    def _render_rollout(self, job: VideoJob) -> Iterator[RenderedRollout | None]:
        """A replay; yields None after each step, and at last what was seen."""
        simulator, seen, error = self._simulator, [], 0.0
        steps = len(job.rollout)
        for t in iter_steps(simulator, job.rollout):
            now = simulator.bodies()
            places = np.array([now[name].position_m for name in job.bodies])
            error = max(error, float(np.linalg.norm(places - job.poses[:, t, :3], axis=1).max()))
            if t < steps:
                seen.append(simulator.observe() if t % job.every == 0 else seen[-1])
            yield None
        yield RenderedRollout(seen, error)
