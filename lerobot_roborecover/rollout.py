"""A rollout and what it is made of: a task, its exact first state, and the actions executed from there.

Pure: numpy and the standard library only.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from lerobot_roborecover.errors import ScenarioError

MAX_PREFIX_STEPS = 20_000
MAX_ACTION_MAGNITUDE = 1e3
MAX_OPTIONS_CHARS = 10_000
_PLATFORM = re.compile(r"[a-z][a-z0-9_]{0,39}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._,'()-]{0,255}")
_POSE = "pose must be 3 finite metres and 4 finite quaternion terms"


@dataclass(frozen=True)
class Pose:
    """A rigid pose in the world frame."""

    position_m: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]

    def __post_init__(self):
        p, q = tuple(map(float, self.position_m)), tuple(map(float, self.quat_xyzw))
        if len(p) != 3 or len(q) != 4 or not np.isfinite(p + q).all():
            raise ScenarioError(f"{_POSE}, got {p} {q}")
        if abs(float(np.linalg.norm(q)) - 1.0) > 1e-3:
            raise ScenarioError(f"quaternion {q} has norm {np.linalg.norm(q):.4f}; a rotation has norm 1")
        object.__setattr__(self, "position_m", p)
        object.__setattr__(self, "quat_xyzw", q)

    @classmethod
    def of(cls, numbers: Sequence[float]) -> Pose:
        """From (7,) numbers, as they are kept in files: position in metres, then quaternion xyzw.

        Raises:
            ScenarioError: they are no seven, or no pose.
        """
        values = tuple(map(float, numbers))
        if len(values) != 7:
            raise ScenarioError(f"{_POSE}, got {values[:3]} {values[3:]}")
        x, y, z, qx, qy, qz, qw = values
        return cls((x, y, z), (qx, qy, qz, qw))

    def distance_m(self, other: Pose) -> float:
        """Euclidean distance between the two positions, metres."""
        return float(np.linalg.norm(np.subtract(self.position_m, other.position_m)))


@dataclass(frozen=True)
class Task:
    """T of the paper: what is to be done, and in how many steps."""

    platform: str
    """Name of a registered platform, e.g. `libero`; `platforms.platform_named` finds it."""
    suite: str
    """The platform's own group of tasks, e.g. `libero_goal`."""
    name: str
    """The platform's own task name, resolved against its catalogue, never used as a path."""
    instruction: str
    """The language instruction given to the policy, verbatim."""
    horizon: int
    """S: new environment steps a trial may take."""

    def __post_init__(self):
        if not isinstance(self.platform, str) or not _PLATFORM.fullmatch(self.platform):
            raise ScenarioError(
                f"platform {str(self.platform)[:80]!r} is not a plain name: 1 to 40 lower-case letters, "
                "digits or '_', a letter first"
            )
        for label in ("suite", "name"):
            value = getattr(self, label)
            if not isinstance(value, str) or not _NAME.fullmatch(value) or ".." in value:
                raise ScenarioError(
                    f"task {label} {str(value)[:80]!r} is not a plain name "
                    "(letters, digits, space and ._,'()- ; at most 256 characters; no path)"
                )
        if not isinstance(self.instruction, str) or not 0 < len(self.instruction) <= 2000:
            raise ScenarioError("task instruction must be text of 1 to 2000 characters")
        if not isinstance(self.horizon, int) or not 1 <= self.horizon <= 100_000:
            raise ScenarioError(f"task horizon {self.horizon!r} is not a step count from 1 to 100000")


@dataclass(frozen=True)
class Reset:
    """What puts a task in its exact first state."""

    seed: int | None = None
    """Seed of the simulator's own random stream at reset."""
    init_state_index: int | None = None
    """Row of the task's stored init states (LIBERO)."""
    settle_steps: int = 0
    """Leading actions of the prefix that only let the scene settle; an initial-state trial starts after
    them."""
    fixtures: Mapping[str, Pose] = field(default_factory=dict)
    """Poses of fixtures that the simulator would otherwise draw at random at each reset (LIBERO), by body
    name.
    Empty: the reset of a fresh environment after `seed`."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """What the environment's own reset takes beside the seed; JSON (`gymnasium.Env.reset`)."""

    def __post_init__(self):
        for label in ("seed", "init_state_index"):
            value = getattr(self, label)
            if value is not None and (not isinstance(value, int) or not 0 <= value < 2**32):
                raise ScenarioError(f"reset {label} {value!r} is not an integer from 0 to 2^32 - 1")
        if not isinstance(self.settle_steps, int) or not 0 <= self.settle_steps <= 1000:
            raise ScenarioError(f"reset settle_steps {self.settle_steps!r} is not a count from 0 to 1000")
        object.__setattr__(self, "fixtures", dict(self.fixtures))
        try:
            text = json.dumps(dict(self.options), sort_keys=True, allow_nan=False)
        except (TypeError, ValueError) as err:
            raise ScenarioError(f"reset options {self.options!r:.200} are not JSON: {err}") from None
        if len(text) > MAX_OPTIONS_CHARS:
            raise ScenarioError(f"reset options are {len(text)} characters; the limit is {MAX_OPTIONS_CHARS}")
        object.__setattr__(self, "options", json.loads(text))

    def as_json(self) -> dict[str, Any]:
        """Plain values; options alone are left out where there are none, as before there were any."""
        fixtures = {name: [*pose.position_m, *pose.quat_xyzw] for name, pose in self.fixtures.items()}
        found = {
            "seed": self.seed,
            "init_state_index": self.init_state_index,
            "settle_steps": self.settle_steps,
            "fixtures": fixtures,
        }
        return found | ({"options": dict(self.options)} if self.options else {})

    @classmethod
    def of_json(cls, values: Mapping[str, Any]) -> Reset:
        """From `as_json`'s.

        Raises:
            ScenarioError: a value is not usable.
            TypeError: a name is none of them.
        """
        given: dict[str, Any] = dict(values)
        given["fixtures"] = {n: Pose.of(v) for n, v in (values.get("fixtures") or {}).items()}
        return cls(**given)


@dataclass(frozen=True)
class Rollout:
    """A task, its exact first state, and the actions executed from there: all that decides a state."""

    task: Task
    reset: Reset
    actions: np.ndarray
    """(T, A) float64: as executed from the reset on, unclipped and unpadded."""

    def __post_init__(self):
        actions = np.asarray(self.actions)
        if actions.dtype != np.float64 or actions.ndim != 2:
            raise ScenarioError(
                f"prefix must be a (steps, action width) float64 array, got shape {actions.shape} of "
                f"{actions.dtype}"
            )
        steps = len(actions)
        if steps > MAX_PREFIX_STEPS:
            raise ScenarioError(f"prefix has {steps} actions; the limit is {MAX_PREFIX_STEPS}")
        bad = np.argwhere(~np.isfinite(actions))
        if len(bad):
            raise ScenarioError(
                f"prefix action {bad[0][0]}, dimension {bad[0][1]} is {actions[tuple(bad[0])]}; "
                "actions must be finite. Record the rollout again: a gap cannot be replayed"
            )
        if steps and np.abs(actions).max() > MAX_ACTION_MAGNITUDE:
            raise ScenarioError(
                f"prefix holds |action| {np.abs(actions).max():.3g}; the limit is {MAX_ACTION_MAGNITUDE:g}"
            )
        if self.reset.settle_steps > steps:
            raise ScenarioError(
                f"settle_steps {self.reset.settle_steps} exceeds the prefix of {steps} actions"
            )
        actions = np.ascontiguousarray(actions)
        actions.setflags(write=False)
        object.__setattr__(self, "actions", actions)

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def platform(self) -> str:
        """The task's platform."""
        return self.task.platform

    def sha256(self) -> str:
        """Hash of everything that decides the state after the last action: task, reset and actions."""
        return self._sha256

    @cached_property
    def _sha256(self) -> str:
        t, r = self.task, self.reset
        head = [
            t.platform,
            t.suite,
            t.name,
            t.instruction,
            t.horizon,
            r.seed,
            r.init_state_index,
            r.settle_steps,
        ]
        fixtures = [[n, *p.position_m, *p.quat_xyzw] for n, p in sorted(r.fixtures.items())]
        about = [head, fixtures, list(self.actions.shape), *([r.options] if r.options else [])]
        digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
        digest.update(self.actions.astype("<f8").tobytes())
        return digest.hexdigest()
