"""Records a rollout inside the simulator's process while a policy or an expert drives.

The recorder wraps the simulator in the simulator's own process, because only there can each perturbed action
be tested for reach. The reply that ends the rollout carries the record to the parent process, which writes
the file: the simulator may run on another machine.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.curation.collect.starts import RolloutSpec
from lerobot_roborecover.curation.rollout import PERTURBED_STEPS, perturb_translations
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.limits import Workspace, limits_of
from lerobot_roborecover.platforms.simulator import Observation, Simulator
from lerobot_roborecover.platforms.starts import stream
from lerobot_roborecover.replay.recorder import PERTURBED, UNPERTURBED, UNREACHABLE, Recorder, Steps
from lerobot_roborecover.scenario import Outcome, Reset, ScenarioError

_SEEN = "seen/"
"""Begins the names of a record's arrays that are of observations."""


@dataclass(frozen=True)
class RecorderSettings:
    """How rollouts are recorded; plain values, so that they travel to a worker."""

    seed: int = 0
    """Seed of the perturbation and of controllers that draw."""
    expert: str = ""
    """Name of the scripted controller; empty where a policy drives."""
    perturbed_steps: int = PERTURBED_STEPS
    """Leading interaction steps in which actions are perturbed."""
    observe_every: int = 0
    """Actions from one recorded observation to the next; 0 records none."""


@dataclass
class Record:
    """One rollout of T actions."""

    reset: Reset
    """With the fixtures' poses."""
    actions: np.ndarray
    """(T, A) float64, as executed."""
    steps: Steps
    margin_rad: np.ndarray
    """(T + 1,) float64: distance of the arm's joints from their limits; NaN where unknown."""
    workspace: Workspace | None
    """Workspace of the reset, where the simulator knows it."""
    observations: list[Observation] | None = None
    """T raw observations, one before each action; None where none were recorded."""
    observe_every: int = 0
    """As in `RecorderSettings`."""
    solved_after: int | None = field(init=False)
    """Actions after which the task's predicate first held, or None."""

    def __post_init__(self):
        held = np.flatnonzero(self.steps.solved)
        self.solved_after = int(held[0]) if len(held) else None


@dataclass(frozen=True)
class RolloutOutcome:
    """How one rollout ended: a line of the journal. Apart from `TrialRow`, since an expert's rollout has no
    protocol, and from `Record`, which is as large as the rollout."""

    rollout: str
    outcome: str
    """A `scenario.Outcome`."""
    steps: int
    """Actions after settling."""
    reason: str = ""
    """Why, where it is neither success nor horizon."""

    @property
    def recorded(self) -> bool:
        """Whether it came to its end, so that there is a record."""
        return Outcome(self.outcome).valid


def record_path(folder: str | os.PathLike[str], rollout_id: str) -> Path:
    """File of a rollout's record."""
    return Path(folder) / f"{rollout_id}.npz"


def pack_record(record: Record) -> bytes:
    """Content of a record's file."""
    about = {
        "schema": 1,
        "bodies": list(record.steps.bodies),
        "reset": record.reset.as_json(),
        "workspace": None if record.workspace is None else asdict(record.workspace),
        "observe_every": record.observe_every,
    }
    seen = [dict(_leaves(o)) for o in record.observations or ()]
    if not all(_is_numbers(value) for value in (seen[0].values() if seen else ())):
        seen = []  # what the file does not hold is seen in a replay
    of_seen: dict[str, Any] = {
        f"{_SEEN}{name}": np.stack([o[name] for o in seen]) for name in (seen[0] if seen else ())
    }
    file = io.BytesIO()
    np.savez_compressed(
        file,
        about=np.array(json.dumps(about)),
        actions=record.actions,
        poses=np.stack(list(record.steps.bodies.values())),
        solved=record.steps.solved,
        perturbation=record.steps.perturbation,
        margin_rad=record.margin_rad,
        **of_seen,
    )
    return file.getvalue()


def read_record(path: Path) -> Record:
    """Reads a file of `pack_record`'s.

    Raises:
        ScenarioError: the file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(str(arrays["about"]))
        place = about["workspace"]
        return Record(
            Reset.of_json(about["reset"]),
            arrays["actions"],
            Steps(
                dict(zip(about["bodies"], arrays["poses"], strict=True)),
                arrays["solved"],
                arrays["perturbation"],
            ),
            arrays["margin_rad"],
            None
            if place is None
            else Workspace(tuple(place["low_m"]), tuple(place["high_m"]), place["support_m"]),
            _observations({k.removeprefix(_SEEN): a for k, a in arrays.items() if k.startswith(_SEEN)}),
            about.get("observe_every", 0),  # files of earlier versions have none
        )
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as err:
        raise ScenarioError(
            f"{path} is not a rollout's record ({err!s:.200}). Delete it: the same command rolls out again"
        ) from None


def _leaves(observation: Observation, prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """An observation's arrays by path."""
    for name, value in observation.items():
        if isinstance(value, Mapping):
            yield from _leaves(dict(value), f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", value


def _is_numbers(value: Any) -> bool:
    """Whether an observation's leaf comes out of a record's file as it went in, and is no picture."""
    return isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and value.ndim < 3


def _observations(arrays: Mapping[str, np.ndarray]) -> list[Observation] | None:
    """T observations again, of arrays by path with a leading dimension T."""
    if not arrays:
        return None
    found: list[Observation] = [{} for _ in range(len(next(iter(arrays.values()))))]
    for path, values in arrays.items():
        *parents, name = path.split("/")
        for whole, value in zip(found, values, strict=True):
            for parent in parents:
                whole = whole.setdefault(parent, {})
            whole[name] = value
    return found


class RecordingSimulator:
    """A simulator that records, and perturbs where the plan says so; everything else is the simulator's.

    Args:
        simulator: of any platform.
        settings: where to, and the perturbation.
    """

    snapshot_is_exact = False
    """A restored snapshot would leave steps unrecorded."""

    def __init__(self, simulator: Simulator, settings: RecorderSettings):
        self.inner = simulator
        self._recorder = Recorder(simulator)
        self._settings = settings
        self._limits = limits_of(simulator)
        self._plan: RolloutSpec | None = None

    def __getattr__(self, name: str) -> Any:
        if name == "inner":  # while it is being made
            raise AttributeError(name)
        return getattr(self.inner, name)

    def plan(self, planned: RolloutSpec) -> None:
        """Names the rollout that the next reset begins."""
        self._plan = planned

    def reset(self, task: Any, reset: Reset) -> None:
        assert self._plan is not None, "reset without a plan"
        self._recorder.reset(task, reset)
        self._noise = None
        self._reach = platform_named(task.platform).perturbation
        if self._plan.disturbed:
            self._noise = stream(self._settings.seed, "perturbation", task, reset, self._plan.trial)
        self._settling, self._last = reset.settle_steps, reset.settle_steps + task.horizon
        self._seen: list[Observation] = []
        self._margins = [self._margin_rad()]

    def step(self, action: np.ndarray) -> None:
        """Perturbs, executes in float64, records."""
        if every := self._settings.observe_every:
            self._seen.append(self._seen[-1] if len(self._recorder) % every else self.inner.observe())
        self._recorder.step(*self._disturbed(np.array(action, dtype=np.float64)))
        self._margins.append(self._margin_rad())

    @property
    def over(self) -> bool:
        """Whether the task is solved or out of steps."""
        return self._recorder.solved[-1] or len(self._recorder) >= self._last

    def _disturbed(self, action: np.ndarray) -> tuple[np.ndarray, int]:
        t = len(self._recorder) - self._settling
        if self._noise is None or not 0 <= t < self._settings.perturbed_steps:
            return action, UNPERTURBED
        # Drawn whether or not it is executed: what comes later does not depend on reach.
        noisy = perturb_translations(action, self._noise, self._reach)
        if self._limits is not None and not self._limits.reachable(noisy):
            return action, UNREACHABLE
        return noisy, PERTURBED

    def _margin_rad(self) -> float:
        return np.nan if self._limits is None else self._limits.joint_margin_rad()

    def record(self) -> Record:
        """The rollout so far."""
        rollout = self._recorder.rollout
        return Record(
            rollout.reset,
            rollout.actions,
            self._recorder.steps,
            np.array(self._margins),
            None if self._limits is None else self._limits.workspace(),
            self._seen or None,
            self._settings.observe_every,
        )
