"""Any Gymnasium environment that LeRobot evaluates, as a simulator whose replays are exact."""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import packages_distributions, version
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_roborecover.platforms.lerobot.pictures import Unseen, unseen
from lerobot_roborecover.platforms.lerobot.source import EnvSource, make_env
from lerobot_roborecover.platforms.lerobot.state import EnvState, numbers, state_of
from lerobot_roborecover.platforms.mujoco_state import pack_arrays, unpack_arrays
from lerobot_roborecover.platforms.simulator import Observation, SimulatorError
from lerobot_roborecover.scenario import Pose, Reset, Task

_KEPT_ENVS = 4
"""Environments kept per simulator, one a task."""
_SEEN_OR_TIMED = re.compile(r"obs_type|render|camera|width|height|max_episode_steps|disable_env_checker")
"""Options of environments that decide no physics."""

_LOG = logging.getLogger(__name__)


class LeRobotSimulator:
    """One environment at a time, reset by seed; replay is `env.step`, success its `info["is_success"]`.

    Args:
        env_type: LeRobot's name, which is the suite of its tasks.
        platform: the platform's name.
        control_hz: control steps a second.
        source: plain values of `EnvSource`.
        task: whose spaces are shown before the first reset.
        exact_snapshots: an environment's Python keeps nothing beside its physics.
        success_key: of a step's info, where the environment's own answer is not `is_success`.
    """

    def __init__(
        self,
        env_type: str,
        platform: str,
        control_hz: float,
        source: Mapping[str, Any],
        task: str,
        exact_snapshots: bool = False,
        success_key: str = "is_success",
    ):
        self.env_type, self.platform, self.control_hz = env_type, platform, control_hz
        self.snapshot_is_exact, self._success_key = exact_snapshots, success_key
        self._source = EnvSource.of(source)
        self._envs: OrderedDict[str, gym.Env] = OrderedDict()
        self.env: gym.Env = self._env_of(task)
        """The environment of the last reset's task."""
        self._unseen: Unseen = unseen(self.env)
        self._space = self._vectors()
        self._step: Callable[[Any], tuple[Any, Any, Any, Any, dict]] = self.env.step
        self._state: EnvState | None = None
        self._seen: Observation = {}
        self._task = task
        self._success = self._ended = self._warned = False

    @property
    def action_dim(self) -> int:
        return self._space.shape[0]

    def _vectors(self) -> gym.spaces.Box:
        space = self.env.action_space
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise SimulatorError(
                f"env type {self.env_type}: its action space is {space}; recorded actions are vectors, "
                "Box(shape=(A,))"
            )
        self._low, self._high = space.low, space.high
        return space

    @property
    def observation_space(self) -> gym.spaces.Dict:
        """The environment's own, without the bounds of numbers: not all environments keep theirs."""
        space = self.env.observation_space
        if not isinstance(space, gym.spaces.Dict):
            raise SimulatorError(
                f"env type {self.env_type}: its observation is {type(space).__name__} {space.shape}, not a "
                "dict of agent_pos, environment_state and pixels, which LeRobot's policies read. Choose "
                "another with --env.base.obs_type"
            )
        return _unbounded(space)

    def reset(self, task: Task, reset: Reset) -> None:
        """Puts a task in the first state of a seed.

        Raises:
            SimulatorError: the task is unknown, the reset names no seed, or the environment takes none.
        """
        if task.suite != self.env_type:
            raise SimulatorError(
                f"task {task.suite}/{task.name}: this simulator is of env type {self.env_type}"
            )
        if reset.seed is None:
            raise SimulatorError(
                f"task {task.name}: reset.seed is None; a Gymnasium environment draws its first state from "
                "a seed, so the scenario's reset must name one (0 to 2^32 - 1)"
            )
        env = self._env_of(task.name)
        if env is not self.env:
            self.env, self._state, self._unseen = env, None, unseen(env)
            self._space = self._vectors()
        self._unseen.before_reset()
        options = dict(reset.options) or None
        with self._unseen:
            try:
                seen, _ = env.reset(seed=reset.seed, options=options)
            except TypeError as err:
                raise SimulatorError(
                    f"env type {self.env_type}: reset(seed=..., options=...) is refused ({err!s:.200}); an "
                    "environment without a seedable reset cannot be rebuilt"
                ) from None
        self._step, self._task = env.step, task.name
        self._take(seen)
        self._state = self._state or state_of(env)
        self._success = self._ended = False

    def step(self, action: np.ndarray) -> None:
        """See `Simulator.step`. After an environment has ended by itself, its state stays what it is."""
        if self._state is None:
            raise SimulatorError("the simulator was not reset yet (or is closed); call reset first")
        if self._ended:
            return
        action = np.asarray(action)
        if action.shape != self._low.shape or not ((action >= self._low) & (action <= self._high)).all():
            self._outside(action)
        with self._unseen:
            seen, _, terminated, _, info = self._step(action)
        try:
            self._success = bool(info[self._success_key])
        except KeyError:
            raise SimulatorError(
                f"env type {self.env_type}: the info of a step holds {', '.join(map(str, info)) or 'nothing'}"
                f", and no {self._success_key}, which is what LeRobot counts. If one of these is the "
                "task's own success, name it: --env.success_key=NAME"
            ) from None
        self._take(seen)
        if terminated and not self._success:
            self._ended = True
            _LOG.warning(
                "env type %s: task %s ended by itself without success; no action changes it any more",
                self.env_type, self._task,
            )  # fmt: skip

    def _outside(self, action: np.ndarray) -> None:
        """Refuses what is no action; says once that one is outside the space."""
        space = self._space
        if action.shape != space.shape or not np.isfinite(action).all():
            raise SimulatorError(
                f"an action of env type {self.env_type} is {space.shape[0]} finite numbers, got shape "
                f"{action.shape}: {action}"
            )
        if not self._warned:
            self._warned = True
            _LOG.warning(
                "env type %s: action %s is outside %s; passed on as it is, as lerobot-eval does (said once)",
                self.env_type, action, space,
            )  # fmt: skip

    def _take(self, seen: Any) -> None:
        if not isinstance(seen, Mapping):
            raise SimulatorError(
                f"env type {self.env_type}: its observation is a {type(seen).__name__}, not a dict of "
                "agent_pos, environment_state and pixels. Choose another with --env.base.obs_type"
            )
        self._seen = dict(seen)

    def observe(self) -> Observation:
        """The environment's own observation, with its pictures."""
        self._ready()
        return self._unseen.complete(self._seen)

    def render(self) -> np.ndarray:
        """(H, W, 3) uint8.

        Raises:
            SimulatorError: the environment draws nothing, or there is no display to be had.
        """
        self._ready()
        try:
            picture = self.env.render()
        except Exception as err:  # each backend raises its own types
            raise SimulatorError(
                f"env type {self.env_type} could not render ({type(err).__name__}: {err!s:.300}). MuJoCo "
                "needs EGL or OSMesa: roborecover doctor"
            ) from err
        if not isinstance(picture, np.ndarray) or picture.ndim != 3:
            raise SimulatorError(
                f"env type {self.env_type}: render() gives a {type(picture).__name__} instead of (H, W, 3) "
                "uint8; its render_mode must be rgb_array"
            )
        return picture

    def succeeded(self) -> bool:
        """`is_success` of the last step; False right after a reset."""
        return self._success

    @property
    def ended(self) -> bool:
        """Whether the environment has ended by itself, without success."""
        return self._ended

    def bodies(self) -> dict[str, Pose]:
        """See `state`: hands and whatever else can move, as far as the environment shows them."""
        return self._ready().bodies(self._seen)

    def state_parts(self) -> dict[str, str]:
        """Hash by part, so that what differs can be named."""
        state = self._ready()
        parts = {**state.parts(), **dict(numbers(self._seen))}
        flags = np.array([self._success, self._ended])
        return {name: _hash(array) for name, array in {**parts, "success": flags}.items()}

    def state_sha256(self) -> str:
        return hashlib.sha256(json.dumps(self.state_parts()).encode()).hexdigest()

    def snapshot(self) -> bytes:
        """The physics; whether that is all is said by `snapshot_is_exact`."""
        return pack_arrays(**self._ready().parts(), ended=np.array([self._success, self._ended]))

    def restore(self, snapshot: bytes) -> None:
        """Puts the physics back, where the environment lets it."""
        arrays = unpack_arrays(snapshot)
        self._success, self._ended = map(bool, arrays.pop("ended"))
        self._ready().restore(arrays)

    def random_actions(self, rng: np.random.Generator, steps: int) -> np.ndarray:
        """(steps, A) float64 that wander about the middle half of the action space; what of it is not bounded
        is taken as -1 to 1.

        Args:
            rng: draws them.
            steps: how many.
        """
        low = np.where(np.isfinite(self._space.low), self._space.low, -1.0).astype(np.float64)
        high = np.where(np.isfinite(self._space.high), self._space.high, 1.0).astype(np.float64)
        middle, reach = (low + high) / 2, (high - low) / 4
        return middle + rng.uniform(-1.0, 1.0, (steps, len(low))) * reach

    def fixtures(self) -> Mapping[str, Pose]:
        """None: seed and options decide everything."""
        return {}

    def fingerprint(self) -> dict[str, str]:
        """Versions of the distributions that make the environment, and its options that decide physics."""
        marks = {}
        modules = {type(self.env.unwrapped).__module__, self._source.package}
        names = {m.partition(".")[0] for m in modules if m} | {"gymnasium"}
        for kind in ("mujoco", "dm_control", "pymunk", "shapely"):
            if self._state is not None and kind in _BEHIND.get(type(self._state).__name__, ()):
                names.add(kind)
        by_module = _distributions()
        for name in sorted(names):
            for distribution in by_module.get(name, ()):
                marks[distribution.lower().replace("_", "-")] = version(distribution)
        decisive = {k: v for k, v in self._source.kwargs.items() if not _SEEN_OR_TIMED.search(k)}
        if decisive:
            marks["env.kwargs"] = json.dumps(decisive, sort_keys=True)
        if self._source.hub:
            marks["env.hub"] = self._source.hub
        return marks

    def close(self) -> None:
        for env in self._envs.values():
            env.close()
        self._envs.clear()
        self._state = None

    def _ready(self) -> EnvState:
        if self._state is None:
            raise SimulatorError("the simulator was not reset yet (or is closed); call reset first")
        return self._state

    def _env_of(self, task: str) -> gym.Env:
        if task in self._envs:
            self._envs.move_to_end(task)
            return self._envs[task]
        env = self._envs[task] = make_env(self._source, task)
        while len(self._envs) > _KEPT_ENVS:
            self._envs.popitem(last=False)[1].close()
        return env


@cache
def _distributions() -> Mapping[str, list[str]]:
    """Distributions by top-level module; every one that is installed has to be looked at."""
    return packages_distributions()


_BEHIND = {"MujocoState": ("mujoco", "dm_control"), "PymunkState": ("pymunk", "shapely")}


def _hash(array: np.ndarray) -> str:
    kept = np.ascontiguousarray(array)
    return hashlib.sha256(f"{kept.dtype.str}{kept.shape}".encode() + kept.tobytes()).hexdigest()


def _unbounded(space: gym.spaces.Dict) -> gym.spaces.Dict:
    made: dict[str, gym.Space[Any]] = {}
    for name, part in space.spaces.items():
        if isinstance(part, gym.spaces.Dict):
            made[name] = _unbounded(part)
        elif isinstance(part, gym.spaces.Box) and np.issubdtype(part.dtype, np.floating):
            made[name] = gym.spaces.Box(-np.inf, np.inf, part.shape, part.dtype.type)
        else:
            made[name] = part
    return gym.spaces.Dict(made)
