"""The recipes of the RoboTwin starter set: which scene, which fault, and how it is labelled."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.build.robotwin.expert import CLEARANCE_M, UP, BlockExpert
from lerobot_roborecover.scenario import DeviationType, Source, Stage

TOWERS = {
    "stack_blocks_two": ("block1", "block2"),
}
"""Blocks of a task from the bottom up: red, then green."""

INSTRUCTIONS = {
    "stack_blocks_two": "Move the red block to the center, then stack the green block on top of it.",
}


@dataclass(frozen=True)
class Recipe:
    """One rollout that goes wrong."""

    task: str
    seed: int
    """RoboTwin's."""
    fault: str
    """A key of `FAULTS`."""
    noise_seed: int | None = None
    """Seed of the perturbation on every joint target; None leaves the driver's actions alone."""

    @property
    def id(self) -> str:
        """Scenario id."""
        noisy = "" if self.noise_seed is None else f"-noise{self.noise_seed}"
        return f"{self.task}-{self.seed}-{self.fault}{noisy}"

    @property
    def source(self) -> Source:
        """Perturbed where noise was added; else the driver's own failure."""
        return Source.NATURAL if self.noise_seed is None else Source.PERTURBED


@dataclass(frozen=True)
class Fault:
    """What a driver does wrong, and what a person looking at the recovery frame would call it."""

    stage: Stage
    deviation: DeviationType
    sees: str
    """The recovery frame in words."""


FAULTS: dict[str, Fault] = {
    "knock": Fault(
        Stage.APPROACH,
        DeviationType.SCENE_CHANGE,
        "the gripper came in too low beside the red block and has pushed it away",
    ),
    "misgrasp": Fault(
        Stage.APPROACH, DeviationType.WRONG_POSE, "the gripper has closed behind the red block, on nothing"
    ),
    "drop": Fault(
        Stage.APPROACH,
        DeviationType.STAGE_ROLLBACK,
        "the gripper opened on the way; the red block that it carried lies on the table below",
    ),
    "beside": Fault(
        Stage.PLACE,
        DeviationType.WRONG_POSE,
        "the gripper holds the green block on the table beside the red one, not on top of it",
    ),
}


def drive(expert: BlockExpert, recipe: Recipe) -> Iterator[np.ndarray]:
    """Actions of the recipe's driver up to its fault, and a moment beyond, so that the scene rests."""
    red, green = TOWERS[recipe.task][:2]
    if recipe.fault == "knock":
        yield from _knock(expert, red)
    elif recipe.fault == "misgrasp":
        side, rotation = expert.approach(red)
        beside = rotation @ np.cross([1.0, 0.0, 0.0], expert.closing(side)) * 0.045
        pick = expert.pick(red, offset=beside)
        yield from _until_closed(expert, pick, side)
    elif recipe.fault == "drop":
        yield from _drop(expert, red)
    elif recipe.fault == "beside":
        yield from expert.stack([red])
        position = np.array(expert.simulator.bodies()[red].position_m)
        away = np.array([0.0, 0.06 if recipe.seed % 2 else -0.06, 0.0])
        yield from _carry(expert, green, position + away)
    else:
        raise ValueError(f"fault {recipe.fault!r} is not one of {sorted(FAULTS)}")
    yield from expert.hold(4)


def _knock(expert: BlockExpert, name: str) -> Iterator[np.ndarray]:
    side, rotation = expert.approach(name)
    start = np.array(expert.simulator.bodies()[name].position_m)
    outwards = np.array([-0.085 if side == "left" else 0.085, 0.0, 0.015])
    yield from expert.move(side, start + outwards + CLEARANCE_M * UP, rotation)
    yield from expert.move(side, start + outwards, rotation)
    yield from expert.move(side, start - 0.2 * outwards, rotation)


def _drop(expert: BlockExpert, name: str) -> Iterator[np.ndarray]:
    yield from expert.pick(name)
    side = expert.side_of_grasp
    start = expert.fingertips(side)
    middle = (start[:3, 3] + np.array([0.0, -0.1, start[2, 3]])) / 2
    yield from expert.move(side, middle, start[:3, :3])
    yield from expert.grip(side, 1.0)


def _carry(expert: BlockExpert, name: str, target: np.ndarray) -> Iterator[np.ndarray]:
    """Brings a body's centre to `target` (3,) metres and holds it there."""
    yield from expert.pick(name)
    side = expert.side_of_grasp
    grasp = expert.fingertips(side)
    goal = target + grasp[:3, 3] - np.array(expert.simulator.bodies()[name].position_m)
    yield from expert.move(side, goal + CLEARANCE_M * UP, grasp[:3, :3])
    yield from expert.move(side, goal, grasp[:3, :3])


def _until_closed(expert: BlockExpert, actions: Iterator[np.ndarray], side: str) -> Iterator[np.ndarray]:
    for action in actions:
        yield action
        if expert.opening(side) < 0.05:
            return


RECIPES: tuple[Recipe, ...] = (
    Recipe("stack_blocks_two", 0, "knock"),
    Recipe("stack_blocks_two", 11, "knock", 11),
    Recipe("stack_blocks_two", 17, "knock", 17),
    Recipe("stack_blocks_two", 2, "misgrasp"),
    Recipe("stack_blocks_two", 3, "misgrasp", 3),
    Recipe("stack_blocks_two", 4, "drop"),
    Recipe("stack_blocks_two", 5, "drop", 5),
    Recipe("stack_blocks_two", 12, "drop", 12),
    Recipe("stack_blocks_two", 6, "beside"),
    Recipe("stack_blocks_two", 10, "beside", 10),
    Recipe("stack_blocks_two", 16, "beside", 16),
)
