"""Scripted drivers by platform and name, good ones and worse ones, for `roborecover collect --expert`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lerobot_roborecover.scenario import ScenarioError, Task

type Driver = Callable[[int], np.ndarray]
"""Next action for the given step; reads the simulator's present state."""
type MakeDriver = Callable[[Any, Task, np.random.Generator], Driver]


def make_driver(name: str, simulator: Any, task: Task, rng: np.random.Generator) -> Driver:
    """A driver for a simulator that has been reset and has settled.

    Args:
        name: of `EXPERTS`.
        simulator: of the task's platform.
        task: what to drive.
        rng: of drivers that draw.
    """
    return EXPERTS[task.platform][name][0](simulator, task, rng)


def check_expert(platform: str, name: str) -> None:
    """Refuses a name that there is not.

    Raises:
        ScenarioError: naming those that there are.
    """
    known = EXPERTS.get(platform, {})
    if name in known:
        return
    if not known:
        raise ScenarioError(
            f"--expert {name}: {platform} has no scripted driver here; use --policy.path=CHECKPOINT"
        )
    there = "; ".join(f"{n} ({about})" for n, (_, about) in known.items())
    raise ScenarioError(f"--expert {name!r:.80}: {platform} has {there}")


def cannot_drive(task: Task) -> str:
    """Why the scripted drivers of a task's platform cannot do it at all; empty where they can try."""
    if task.platform != "libero":
        return ""
    from lerobot_roborecover.build.libero.scene import PICK_AND_PLACE
    from lerobot_roborecover.simulators.catalog import libero_goal

    goal = libero_goal(task.suite, task.name)
    if any(predicate[0] in PICK_AND_PLACE for predicate in goal):
        return ""
    return "nothing is to be picked and placed: " + ", ".join(" ".join(predicate) for predicate in goal)


def _metaworld(kind: str) -> MakeDriver:
    def make(simulator: Any, task: Task, rng: np.random.Generator) -> Driver:
        from lerobot_roborecover.build.metaworld import experts

        if kind == "expert":
            return experts.expert(simulator, task.name)
        return getattr(experts, kind)(simulator, task.name, rng)

    return make


def _libero(flaws: Callable[[np.random.Generator], Mapping[str, Any]]) -> MakeDriver:
    def make(simulator: Any, task: Task, rng: np.random.Generator) -> Driver:
        from lerobot_roborecover.build.libero.expert import Flaws, LiberoExpert
        from lerobot_roborecover.build.libero.scene import LiberoScene

        driver = LiberoExpert(LiberoScene(simulator), Flaws(**flaws(rng)))
        return lambda _t: driver.act()

    return make


def _drawn_flaw(rng: np.random.Generator) -> dict[str, Any]:
    """One of the flaws of the starter set's drivers, which fit any pick-and-place task, and its size."""
    angle, side = rng.uniform(0, 2 * np.pi), np.zeros(3)
    side[:2] = np.cos(angle), np.sin(angle)
    kinds = (
        {"aim_m": tuple((rng.uniform(0.03, 0.06) * side).tolist())},
        {"turn_rad": float(rng.uniform(1.2, 1.6))},
        {"drop_after": int(rng.integers(3, 18))},
        {"place_m": tuple((rng.uniform(0.06, 0.11) * side[:2]).tolist())},
        {"carry_m": -float(rng.uniform(0.08, 0.14))},
    )
    return {"open_loop": True, **kinds[int(rng.integers(len(kinds)))]}


def _fake(lag: float) -> MakeDriver:
    def make(simulator: Any, task: Task, rng: np.random.Generator) -> Driver:
        """Goes around the puck and pushes it at the goal."""
        goal = np.array({"push-left": (-0.3, 0.0)}.get(task.name, (0.3, 0.0)))
        offset = rng.uniform(-lag, lag, 2)

        def act(_t: int) -> np.ndarray:
            poses = simulator.bodies()
            mass, puck = (np.array(poses[n].position_m[:2]) for n in ("eef", "puck"))
            puck = puck + offset
            toward = (goal - puck) / max(float(np.linalg.norm(goal - puck)), 1e-6)
            gap = mass - puck
            along = float(gap @ toward)
            across = np.array([-toward[1], toward[0]])
            if along < 0 and abs(float(gap @ across)) < 0.03:
                target = goal
            elif along > -0.04:
                target = puck + across * np.sign(float(gap @ across) or 1.0) * 0.13 - 0.05 * toward
            else:
                target = puck - 0.11 * toward
            return np.clip(8.0 * (target - mass), -1.0, 1.0)

        return act

    return make


EXPERTS: Mapping[str, Mapping[str, tuple[MakeDriver, str]]] = {
    "metaworld": {
        "expert": (_metaworld("expert"), "Meta-World's own scripted policy"),
        "expert_biased": (_metaworld("biased_expert"), "sees the object 1.5 to 4.5 cm off"),
        "expert_weak_grip": (_metaworld("weak_grip_expert"), "closes with 3 to 30 % of the force"),
        "patient_expert": (_metaworld("patient_expert"), "backs off and tries again"),
    },
    "libero": {
        "scripted": (_libero(lambda _r: {}), "pick and place, tries again"),
        "scripted-open-loop": (_libero(lambda _r: {"open_loop": True}), "plans once, one attempt"),
        "scripted-weak": (_libero(_drawn_flaw), "one attempt with a flaw that it draws"),
    },
    "fake": {"expert": (_fake(0.0), "pushes the puck"), "expert_biased": (_fake(0.1), "sees the puck off")},
}
"""Driver and a few words on it, by platform and name."""
