"""Finds the complete state of a third-party environment, and its bodies' poses.

The first kind that fits is used: MuJoCo's integration state (also behind dm_control), the bodies of a pymunk
space, a `get_state`/`set_state` pair, or the observation.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from lerobot_roborecover.platforms.simulator import GOAL, HANDLE, Observation, SimulatorError
from lerobot_roborecover.scenario import Pose

UNTURNED = (0.0, 0.0, 0.0, 1.0)
_HAND = re.compile(r"(^|[/_.-])(eef|tcp|end_?effector|gripper(_?(link|base|site))?|hand|ee)$", re.IGNORECASE)
_NESTED = ("_env", "env", "sim", "_sim", "physics", "simulator")
"""Attributes behind which environments keep the simulator they wrap."""
_DEPTH = 4
_FREE_JOINT = 0
"""`mujoco.mjtJoint.mjJNT_FREE`."""


class EnvState(Protocol):
    kind: str
    """In a few words, for people."""

    def parts(self) -> dict[str, np.ndarray]:
        """Everything that decides what comes next, by name."""

    def bodies(self, observation: Observation) -> dict[str, Pose]:
        """As `Simulator.bodies`."""

    def restore(self, parts: Mapping[str, np.ndarray]) -> None:
        """Puts `parts` back, as well as it can be done.

        Raises:
            SimulatorError: this kind cannot.
        """


def state_of(env: gym.Env) -> EnvState:
    """The state of an environment that was reset.

    Args:
        env: any.
    """
    inner = env.unwrapped
    for found in _objects(inner):
        pair = _mujoco_pair(found)
        if pair is not None:
            return MujocoState(*pair)
    space = getattr(inner, "space", None)
    if type(space).__module__.partition(".")[0] == "pymunk":
        return PymunkState(inner)
    if callable(getattr(inner, "get_state", None)) and callable(getattr(inner, "set_state", None)):
        return PairState(inner)
    return ObservationState()


class MujocoState:
    """State of a MuJoCo model and its data.

    Args:
        model: `mujoco.MjModel`.
        data: `mujoco.MjData`.
    """

    kind = "MuJoCo's integration state"

    def __init__(self, model: Any, data: Any):
        from lerobot_roborecover.platforms import mujoco_state

        self._mujoco, self._model, self._data = mujoco_state, model, data
        hands = [b for b in range(1, model.nbody) if _HAND.search(model.body(b).name)]
        self._hands = hands or [_last_of_longest_chain(model)]
        roots = {int(model.body_rootid[b]) for b in range(1, model.nbody) if not _floats(model, b)}
        robots = [r for r in roots if any(int(model.body_rootid[h]) == r for h in self._hands)]
        self._movable = mujoco_state.movable_bodies(model, exclude=robots)

    def parts(self) -> dict[str, np.ndarray]:
        return {"mujoco": self._mujoco.save_state(self._model, self._data)}

    def restore(self, parts: Mapping[str, np.ndarray]) -> None:
        """Puts it back; what the environment's Python keeps beside it is not in it."""
        import mujoco

        self._mujoco.load_state(self._model, self._data, parts["mujoco"])
        mujoco.mj_forward(self._model, self._data)
        # forward overwrote the solver's warm start
        self._mujoco.load_state(self._model, self._data, parts["mujoco"])

    def bodies(self, observation: Observation) -> dict[str, Pose]:
        """Hands by name, and whatever else has a joint of its own."""
        found = {}
        for body in self._hands:
            label = "eef" if len(self._hands) == 1 else f"eef.{self._model.body(body).name}"
            found[label] = self._mujoco.body_pose(self._data, body)
        for name, body in self._movable.items():
            if body not in self._hands:
                found[name] = self._mujoco.body_pose(self._data, body)
        return found


class PymunkState:
    """State of a plane of pymunk's bodies, whose pixels are taken as millimetres. The solver's contact cache
    is out of reach, so a restored state drifts.

    Args:
        inner: the environment; attributes that are bodies name them, and `agent` is the end effector.
    """

    kind = "the bodies of a pymunk space"
    METRES = 1e-3
    """Of a pixel: PushT's window is 512 wide, about as many millimetres as its table."""

    def __init__(self, inner: Any):
        self._inner = inner

    def _named(self) -> dict[str, Any]:
        kind = type(self._inner.space.static_body)
        return {n: b for n, b in sorted(vars(self._inner).items()) if isinstance(b, kind)}

    def parts(self) -> dict[str, np.ndarray]:
        """Ten numbers a body."""
        return {
            name: np.array(
                [*b.position, b.angle, *b.velocity, b.angular_velocity, *b.force, b.torque], np.float64
            )
            for name, b in self._named().items()
        }

    def restore(self, parts: Mapping[str, np.ndarray]) -> None:
        raise SimulatorError("pymunk's solver remembers contacts that cannot be read: replay instead")

    def bodies(self, observation: Observation) -> dict[str, Pose]:
        """On the plane z = 0, y downwards as in the picture. Where the environment has a `goal_pose`, the
        middle of the one body that is not the agent, and where that belongs."""
        found = {
            "eef" if name == "agent" else name: self._pose(*b.position, b.angle)
            for name, b in self._named().items()
        }
        goal = getattr(self._inner, "goal_pose", None)
        objects = [n for n in self._named() if n != "agent"]
        if goal is not None and len(objects) == 1:
            body = self._named()[objects[0]]
            x, y = body.center_of_gravity
            found[objects[0] + HANDLE] = self._pose(*body.local_to_world((x, y)), body.angle)
            gx, gy, angle = map(float, goal)
            c, s = np.cos(angle), np.sin(angle)
            found[GOAL] = self._pose(gx + c * x - s * y, gy + s * x + c * y, angle)
        return found

    def _pose(self, x: float, y: float, angle: float) -> Pose:
        half = angle / 2.0
        turned = (0.0, 0.0, float(np.sin(half)), float(np.cos(half)))
        return Pose((x * self.METRES, y * self.METRES, 0.0), turned)


class PairState:
    """State of an environment with `get_state()` and `set_state(state)`.

    Args:
        inner: the environment.
    """

    kind = "the environment's get_state()"

    def __init__(self, inner: Any):
        self._inner = inner

    def parts(self) -> dict[str, np.ndarray]:
        """What `get_state` gives: an array, or a mapping or sequence of them."""
        return dict(_flat("state", self._inner.get_state()))

    def restore(self, parts: Mapping[str, np.ndarray]) -> None:
        """Gives one array back; a structure cannot be distinguished from its parts."""
        if set(parts) != {"state"}:
            raise SimulatorError("get_state() gives a structure, of which only the parts are kept: replay")
        self._inner.set_state(parts["state"].copy())

    def bodies(self, observation: Observation) -> dict[str, Pose]:
        return ObservationState().bodies(observation)


class ObservationState:
    """State of an environment that shows nothing but its observation, which is in the hash anyway."""

    kind = "the observation alone"

    def parts(self) -> dict[str, np.ndarray]:
        return {}

    def restore(self, parts: Mapping[str, np.ndarray]) -> None:
        raise SimulatorError("an environment that shows its observation alone cannot be put back: replay")

    def bodies(self, observation: Observation) -> dict[str, Pose]:
        """`eef`: the first three values of `agent_pos`, as if they were metres, for lack of anything else."""
        seen = np.zeros(3)
        values = np.asarray(observation.get("agent_pos", ()), np.float64).ravel()[:3]
        seen[: len(values)] = np.nan_to_num(values)
        return {"eef": Pose(tuple(seen), UNTURNED)}


def numbers(observation: Any, name: str = "observation") -> Iterator[tuple[str, np.ndarray]]:
    """An observation's arrays that are no pictures, (name, float64 or as they are).

    Args:
        observation: nested dicts of arrays.
        name: of the whole.
    """
    for label, value in _flat(name, observation):
        if not (value.dtype == np.uint8 and value.ndim >= 3):
            yield label, value


def _flat(name: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield from _flat(f"{name}.{key}", value[key])
    elif isinstance(value, (list, tuple)) and any(isinstance(v, (Mapping, np.ndarray)) for v in value):
        for i, part in enumerate(value):
            yield from _flat(f"{name}.{i}", part)
    elif isinstance(value, bytes):
        yield name, np.frombuffer(value, np.uint8)
    else:
        array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
        if array.dtype != object:
            yield name, array


def _objects(root: Any) -> Iterator[Any]:
    """An environment, and what it keeps the simulator behind."""
    seen, queue = set(), [(root, 0)]
    while queue:
        found, depth = queue.pop(0)
        if id(found) in seen or found is None:
            continue
        seen.add(id(found))
        yield found
        if depth < _DEPTH:
            queue += [(vars_of(found).get(n, getattr(type(found), n, None)), depth + 1) for n in _NESTED]


def vars_of(found: Any) -> dict[str, Any]:
    """An object's own attributes; empty where it keeps none in a dict."""
    return getattr(found, "__dict__", {})


def physics_of(env: gym.Env) -> Any:
    """dm_control's physics behind an environment; None where there is none."""
    for found in _objects(env.unwrapped):
        for physics in (found, vars_of(found).get("_physics")):
            dm = type(physics).__module__.startswith("dm_control")
            if dm and hasattr(physics, "model") and hasattr(physics, "render"):
                return physics
    return None


def _mujoco_pair(found: Any) -> tuple[Any, Any] | None:
    try:
        import mujoco
    except ModuleNotFoundError:
        return None
    for holder in (found, vars_of(found).get("_physics")):
        model, data = getattr(holder, "model", None), getattr(holder, "data", None)
        model, data = getattr(model, "ptr", model), getattr(data, "ptr", data)
        model, data = getattr(model, "_model", model), getattr(data, "_data", data)
        if isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData):
            return model, data
    return None


def _floats(model: Any, body: int) -> bool:
    first = int(model.body_jntadr[int(model.body_rootid[body])])
    return first >= 0 and int(model.jnt_type[first]) == _FREE_JOINT


def _last_of_longest_chain(model: Any) -> int:
    """The body with the most joints above it that are not free: where a robot's hand would be."""
    depth = np.zeros(model.nbody, int)
    for body in range(1, model.nbody):
        own = 0 if _floats(model, body) else int(model.body_jntnum[body])
        depth[body] = depth[int(model.body_parentid[body])] + own
    return int(depth.argmax()) if model.nbody > 1 else 0
