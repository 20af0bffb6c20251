"""Replays a scenario's drawn screening runs in a worker process, and measures.

Imports neither LeRobot nor torch, so that a process starts in a second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np

from lerobot_roborecover.curation.validate.frames import Originals, encoded, ssim, window
from lerobot_roborecover.curation.validate.sheets import draw_sheet
from lerobot_roborecover.curation.validate.validation import CRASH, INVALID_ACTION, Replays, RunReplay
from lerobot_roborecover.datasets.frames import KEPT, camera_pictures
from lerobot_roborecover.platforms import Simulator, SimulatorError
from lerobot_roborecover.platforms.simulator import Steppable, follow
from lerobot_roborecover.scenario import Pose, Scenario, ScenarioError
from lerobot_roborecover.workers.jobs import drop_simulators_of_worker, simulator_of_worker


@dataclass(frozen=True)
class DrawnRun:
    """A screening run to replay. Apart from `LoggedTrial`: it travels to a process that needs no row."""

    policy: str
    """Its name in the trials' folder."""
    trial: int
    actions: np.ndarray
    """(n, A), of the type that the policy gave."""
    success: bool
    control_mode: str | None = None
    """How its actions are read, where the simulator has more than one way."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Simulator options that differ from the job's, e.g. `action_mode`."""


@dataclass(frozen=True)
class OriginalRollout:
    """The rollout that a scenario was made from, around its recovery point."""

    poses: Mapping[int, Mapping[str, Pose]]
    """Recorded poses by step."""
    after: np.ndarray
    """(n, A) float64 actions from the recovery point on."""
    steps: int
    """Actions of the whole rollout, and frames of its video."""
    frame_stride: int = 1
    """Steps from one picture of its video to the next; what was seen stands until then."""


@dataclass(frozen=True)
class ReplayJob:
    """Work of one replay process."""

    scenario: Scenario
    runs: tuple[DrawnRun, ...]
    options: Mapping[str, Any]
    """Options of the simulator."""
    rollout: OriginalRollout | None = None
    originals: Originals | None = None
    """None compares no frames."""
    sheet: bool = False
    """Whether to draw original, replay and difference."""
    key: str = ""


@dataclass(frozen=True)
class ReplayReport:
    """What comes back of a job; the parent writes it down."""

    replays: Replays
    sheet: bytes = b""
    """A PNG; empty where there is nothing to see."""


class _InvalidAction(Exception):
    """The simulator refused an action."""


@dataclass
class _ReplayTrace:
    """Record of a replay, by step."""

    bodies: dict[int, dict[str, Pose]] = field(default_factory=dict)
    pictures: dict[int, dict[str, np.ndarray]] = field(default_factory=dict)


def replay_job(job: ReplayJob) -> ReplayReport:
    """Replays everything; what the simulator does wrong is in the result."""
    try:
        return _replay(job)
    except _InvalidAction as err:
        failed = Replays(error=str(err), error_kind=INVALID_ACTION)
    except (SimulatorError, RuntimeError, ArithmeticError) as err:
        failed = Replays(error=f"{type(err).__name__}: {err}", error_kind=CRASH)
    drop_simulators_of_worker()
    return ReplayReport(failed)


def _replay(job: ReplayJob) -> ReplayReport:
    scenario, originals = job.scenario, job.originals

    def simulator_of(options: Mapping[str, Any]) -> Simulator:
        return simulator_of_worker({**job.options, **options})

    first = _seen_from(scenario, originals, job.rollout)
    runs, seen = [], []
    for run in job.runs:
        found, met = _replay_run(simulator_of(run.options), job, run, first)
        runs.append(found)
        seen.append(met)
    after_mm = None
    tail: dict[int, dict[str, np.ndarray]] = {}
    if job.rollout is not None and len(job.rollout.after):
        met = _walk(simulator_of({}), scenario, len(scenario.prefix), False)
        _go_on(simulator_of({}), scenario, job.rollout.after, met, bool(originals and originals.encoders))
        tail = met.pictures
        recorded = {s: p for s, p in job.rollout.poses.items() if s > len(scenario.prefix)}
        if recorded:
            after_mm = max(_displacements(met.bodies, recorded)[:2])
    similarity, worst = _compare_frames(job, seen, tail) if originals else ({}, None)
    sheet = b""
    if job.sheet and worst is not None and originals is not None:
        sheet = draw_sheet(scenario.id, len(scenario.prefix), originals.pictures, worst)
    poses = seen[0].bodies[len(scenario.prefix)] if seen else {}
    found = Replays(
        tuple(runs),
        after_mm,
        similarity,
        originals.how if originals else "none (--no-frames)",
        bodies={name: (*p.position_m, *p.quat_xyzw) for name, p in poses.items()},
        versions=dict(simulator_of(job.runs[0].options).fingerprint()) if job.runs else {},
    )
    return ReplayReport(found, sheet)


def _seen_from(scenario: Scenario, originals: Originals | None, rollout: OriginalRollout | None) -> int:
    """The first step whose picture is needed."""
    step = len(scenario.prefix)
    first = max(step - KEPT + 1, 0)
    if originals is not None and originals.encoders and rollout is not None:
        first = min(first, *(window(step, rollout.steps, e).start for e in originals.encoders.values()))
        first -= first % rollout.frame_stride
    return first


@dataclass(frozen=True)
class _Refusing:
    """A simulator, or a history on it, whose refusal of an action says which one it was."""

    inner: Steppable
    what: Callable[[int], str]
    """Names an action by its number, for the message."""
    numbers: Iterator[int]

    def step(self, action: np.ndarray) -> None:
        what = self.what(next(self.numbers))
        if not np.isfinite(action).all():
            raise _InvalidAction(f"{what} is not finite: {action}")
        try:
            self.inner.step(action)
        except (SimulatorError, ScenarioError, ValueError) as err:
            raise _InvalidAction(f"{what}: {err}") from err


def _follow(
    simulator: Steppable, actions: np.ndarray, what: Callable[[int], str], first: int = 0
) -> Iterator[int]:
    """See `follow`; what the simulator refuses is an `_InvalidAction`."""
    return follow(_Refusing(simulator, what, count(first)), actions, first)


def _walk(simulator: Simulator, scenario: Scenario, first: int, pictures: bool) -> _ReplayTrace:
    """Resets, replays the prefix, and looks from a step on."""
    seen = _ReplayTrace()
    simulator.reset(scenario.task, scenario.reset)
    for step in _follow(simulator, scenario.prefix, lambda n: f"prefix action {n}"):
        if step >= first:
            _look(simulator, scenario, step, seen, pictures)
    return seen


def _look(simulator: Simulator, scenario: Scenario, step: int, seen: _ReplayTrace, pictures: bool) -> None:
    seen.bodies[step] = simulator.bodies()
    if pictures:
        seen.pictures[step] = camera_pictures(scenario.platform, simulator.observe())


def _go_on(
    simulator: Simulator, scenario: Scenario, actions: np.ndarray, seen: _ReplayTrace, pictures: bool
) -> None:
    """The rollout's own further steps."""
    t = len(scenario.prefix)
    for step in _follow(simulator, actions, lambda n: f"rollout action {n}", t):
        if step > t:
            _look(simulator, scenario, step, seen, pictures)


def _replay_run(
    simulator: Simulator, job: ReplayJob, run: DrawnRun, first: int
) -> tuple[RunReplay, _ReplayTrace]:
    """Prefix and run, once."""
    from lerobot_roborecover.replay.rollback import RollbackHistory

    scenario, step = job.scenario, len(job.scenario.prefix)
    seen = _walk(simulator, scenario, first, job.originals is not None)
    recorded: dict[int, Mapping[str, Pose]] = {}
    if job.rollout is not None:
        recorded |= {s: p for s, p in job.rollout.poses.items() if s <= step}
    if scenario.fingerprint is not None:
        # Last: where both are known, what evaluation will compare with must hold.
        recorded[step] = scenario.fingerprint.bodies
    eef, objects, worst = _displacements(seen.bodies, recorded)
    state, solved = simulator.state_sha256(), simulator.succeeded()
    history = RollbackHistory(simulator, scenario.rollout, step, control_mode=run.control_mode)
    ended = ("horizon", len(run.actions))
    for number in _follow(history, run.actions, lambda n: f"action {n} of {run.policy}, trial {run.trial}"):
        if number and simulator.succeeded():
            ended = ("success", number)
            break
    outcome = "success" if run.success else "horizon"
    replay = RunReplay(
        run.policy, run.trial, eef, objects, worst, solved, state, (outcome, len(run.actions)), ended
    )
    return replay, seen


def _displacements(
    met: Mapping[int, Mapping[str, Pose]], recorded: Mapping[int, Mapping[str, Pose]]
) -> tuple[float, float, str]:
    """Largest displacement of end effectors and of objects, millimetres, and which and when.

    Raises:
        SimulatorError: the simulator lacks a recorded body.
    """
    eef = objects = -1.0
    worst = ""
    for step, poses in sorted(recorded.items()):
        for name, pose in poses.items():
            if step not in met or name not in met[step]:
                raise SimulatorError(f"the simulator has no body {name!r} at step {step}, which was recorded")
            distance = met[step][name].distance_m(pose) * 1e3
            if distance > max(eef, objects):
                worst = f"{name} at step {step}"
            if name.startswith("eef"):
                eef = max(eef, distance)
            else:
                objects = max(objects, distance)
    return max(eef, 0.0), max(objects, 0.0), worst


def _compare_frames(
    job: ReplayJob, seen: Sequence[_ReplayTrace], tail: Mapping[int, Mapping[str, np.ndarray]]
) -> tuple[dict[str, tuple[float, ...]], dict[str, np.ndarray] | None]:
    """SSIM by camera of the replay that fares worst, and its frames."""
    assert job.originals is not None
    found: dict[str, tuple[float, ...]] = {}
    worst: dict[str, np.ndarray] | None = None
    before: list[_ReplayTrace] = []
    for met in seen:
        if any(_same(met, other) for other in before):
            continue
        before.append(met)
        frames = _frames(job, met, tail)
        values = {c: ssim(job.originals.pictures[c], frames[c]) for c in job.originals.pictures}
        if worst is None or _least(values) < _least(found):
            found, worst = values, frames
    return found, worst


def _least(values: Mapping[str, Sequence[float]]) -> float:
    return min(float(np.mean(v)) for v in values.values())


def _same(one: _ReplayTrace, other: _ReplayTrace) -> bool:
    return all(
        np.array_equal(picture, other.pictures[step][camera])
        for step, pictures in one.pictures.items()
        for camera, picture in pictures.items()
    )


def _frames(
    job: ReplayJob, met: _ReplayTrace, tail: Mapping[int, Mapping[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """(K, H, W, 3) uint8 by camera, encoded as the originals were."""
    assert job.originals is not None
    step = len(job.scenario.prefix)
    result = {}
    for camera, pictures in job.originals.pictures.items():
        if camera not in met.pictures[step]:
            raise ScenarioError(
                f"the original has camera {camera!r}, the replay {sorted(met.pictures[step])}; render as the "
                "original was rendered, e.g. with --env camera_name=..."
            )
        wanted = range(step + 1 - len(pictures), step + 1)
        encoder = job.originals.encoders.get(camera)
        if encoder is None or job.rollout is None:
            result[camera] = np.stack([met.pictures[s][camera] for s in wanted])
            continue
        clip = window(step, job.rollout.steps, encoder)
        every = job.rollout.frame_stride
        rendered = [s - s % every for s in clip]
        frames = [met.pictures[s][camera] if s <= step else tail[s][camera] for s in rendered]
        if frames[0].shape != pictures.shape[1:]:
            result[camera] = np.stack(frames)  # other sizes: `ssim` says so
            continue
        decoded = encoded(frames, encoder)
        result[camera] = np.stack([decoded[s - clip.start] for s in wanted])
    return result
