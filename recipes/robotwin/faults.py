"""What a scripted controller does wrong, and what a person who looks at the recovery frame calls it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.scenario import DeviationType, Stage
from recipes.robotwin.expert import CLEARANCE_M, TABLE_M, UP, BlockExpert
from recipes.robotwin.handover import (
    GRASPS_M,
    PASSING_M,
    PASSING_TO,
    carry,
    carry_down,
    grasp,
    grasp_open,
    take,
)
from recipes.robotwin.plans import ORDERS, ROW_XY_M, goal, put

HANDOVER = "handover_block"
PAD_M = 0.01
"""Thickness of its pad."""

type Controller = Callable[[BlockExpert, str, int], Iterator[np.ndarray]]
"""Actions up to the recovery point, for an expert at a task's start, the task and the seed."""


@dataclass(frozen=True)
class Fault:
    """One way to go wrong."""

    stage: Stage
    deviation: DeviationType
    sees: str
    """The recovery frame in words; `{first}`, `{second}` and `{last}` are the bodies in the order of
    handling, `{held}` the second one where there is one."""
    drive: Controller
    touches: bool = True
    """Whether a body other than the arms has to have moved for the fault to have happened."""

    def words(self, task: str) -> str:
        """What a person sees in a task's recovery frame."""
        names = [NAMES.get(task, _COLOURS)[body] for body in ORDERS[task]]
        second = names[min(1, len(names) - 1)]
        return self.sees.format(first=names[0], second=second, held=second, last=names[-1])


_COLOURS = {"block1": "the red block", "block2": "the green block", "block3": "the blue block"}
NAMES = {
    "blocks_ranking_size": {
        "block1": "the largest block",
        "block2": "the middle block",
        "block3": "the smallest block",
    },
    "handover_block": {"box": "the red block"},
}
"""Bodies in words, where they are not the three colours."""


def drive(expert: BlockExpert, task: str, fault: str, seed: int) -> Iterator[np.ndarray]:
    """Actions of a controller up to its fault, and a moment beyond, so that the scene rests."""
    yield from FAULTS[fault].drive(expert, task, seed)
    yield from expert.hold(4)


def _check_reachable(expert: BlockExpert, task: str, seed: int) -> Iterator[np.ndarray]:
    name = ORDERS[task][0]
    side, rotation = expert.approach(name)
    start, _ = expert.body(name)
    outwards = np.array([-0.085 if side == "left" else 0.085, 0.0, 0.015])
    yield from expert.move(side, start + outwards + CLEARANCE_M * UP, rotation)
    yield from expert.move(side, start + outwards, rotation)
    yield from expert.move(side, start - 0.2 * outwards, rotation)


def _misgrasp(expert: BlockExpert, task: str, seed: int) -> Iterator[np.ndarray]:
    name = ORDERS[task][0]
    if task == HANDOVER:
        yield from grasp_open(expert, "left", name, GRASPS_M["left"], miss_m=0.1 if seed % 2 else -0.1)
        yield from expert.grip("left", 0.0)
        return
    side, rotation = expert.approach(name)
    beside = rotation @ np.cross([1.0, 0.0, 0.0], expert.closing(side)) * (0.02 + expert.half_width(name))
    yield from _until_closed(expert, expert.pick(name, offset=beside), side)


def _press(expert: BlockExpert, task: str, seed: int) -> Iterator[np.ndarray]:
    name = ORDERS[task][0]
    side, rotation = expert.approach(name)
    top = expert.body(name)[0] + (expert.half_height(name) + 0.004) * UP
    yield from expert.move(side, top + CLEARANCE_M * UP, rotation)
    yield from expert.grip(side, 0.0)
    yield from expert.move(side, top, rotation)


def _drop(expert: BlockExpert, task: str, seed: int) -> Iterator[np.ndarray]:
    name = ORDERS[task][0]
    if task == HANDOVER:
        low = TABLE_M + expert.half_height(name) + 0.015
        yield from grasp(expert, "left", name, GRASPS_M["left"])
        yield from carry(expert, "left", name, np.array([*PASSING_M[:2], low]), PASSING_TO)
        yield from expert.grip("left", 1.0)
        return
    yield from expert.pick(name)
    side = expert.side_of_grasp
    start = expert.fingertips(side)
    middle = (start[:3, 3] + np.array([0.0, -0.1, start[2, 3]])) / 2
    yield from expert.move(side, middle, start[:3, :3])
    yield from expert.grip(side, 1.0)


def _astray(expert: BlockExpert, task: str, seed: int) -> Iterator[np.ndarray]:
    name = ORDERS[task][0]
    if task == HANDOVER:
        position, _ = expert.body(name)
        yield from grasp(expert, "left", name, GRASPS_M["left"])
        aside = np.array([-0.28, max(position[1], 0.06), position[2] + 0.08])
        yield from carry(expert, "left", name, aside)
        return
    yield from expert.pick(name)
    side = expert.side_of_grasp
    start = expert.fingertips(side)
    outwards = np.array([-0.1 if side == "left" else 0.1, 0.04 if seed % 2 else -0.04, 0.0])
    yield from expert.move(side, start[:3, 3] + outwards, start[:3, :3])


def _wrong_block(expert: BlockExpert, task: str, seed: int) -> Iterator[np.ndarray]:
    first, *_, last = ORDERS[task]
    yield from put(expert, task, first)
    side, _ = expert.approach(last)
    pick = expert.pick(last)
    yield from _until_closed(expert, pick, side) if seed % 2 else _until_low(expert, pick, side, last)


def _onto_wrong(expert: BlockExpert, task: str, seed: int) -> Iterator[np.ndarray]:
    first, second, *_ = ORDERS[task]
    on_top = expert.body(second)[0] + 2 * expert.half_height(second) * UP
    yield from _carry(expert, first, on_top + 0.004 * UP)


def _wrong_slot(expert: BlockExpert, task: str, seed: int) -> Iterator[np.ndarray]:
    first, *_, last = ORDERS[task]
    yield from _carry(expert, first, np.array([*ROW_XY_M[last], goal(expert, task, first)[2]]))


def _beside(expert: BlockExpert, task: str, seed: int) -> Iterator[np.ndarray]:
    first, *others = ORDERS[task]
    if task == HANDOVER:
        away = np.array([0.02, -0.11, 0.002 - PAD_M])
        yield from take(expert, first)
        yield from carry_down(expert, first, goal(expert, task, first) + away)
        return
    yield from put(expert, task, first)
    held = others[0]
    away = np.array([0.0, 0.06 if seed % 2 else -0.06, 0.0])
    if task.startswith("stack"):
        away[2] = expert.body(first)[0][2] - goal(expert, task, held)[2]
    yield from _carry(expert, held, goal(expert, task, held) + away)


def _shove(expert: BlockExpert, task: str, seed: int) -> Iterator[np.ndarray]:
    first, second, *_ = ORDERS[task]
    yield from put(expert, task, first)
    before, _ = expert.body(first)
    side = "left" if expert.body(second)[0][0] < 0 else "right"
    outwards = np.array([-1.0 if side == "left" else 1.0, 0.0, 0.0])
    beside = before + (0.02 + 2 * expert.half_width(first)) * outwards + 0.008 * UP
    yield from _carry(expert, second, beside)
    grasp = expert.fingertips(side)
    yield from expert.move(side, grasp[:3, 3] - 0.07 * outwards, grasp[:3, :3])


def _topple(expert: BlockExpert, task: str, seed: int) -> Iterator[np.ndarray]:
    first, second, *_ = ORDERS[task]
    yield from put(expert, task, first)
    yield from put(expert, task, second)
    position, _ = expert.body(second)
    side = "left" if seed % 2 else "right"
    outwards = np.array([-0.1 if side == "left" else 0.1, 0.0, 0.0])
    rotation = expert.top_down(side, np.eye(3))
    yield from expert.grip(side, 0.0)
    yield from expert.move(side, position + outwards + CLEARANCE_M * UP, rotation)
    yield from expert.move(side, position + outwards + 0.012 * UP, rotation)
    yield from expert.move(side, position - 0.3 * outwards + 0.012 * UP, rotation)


def _carry(expert: BlockExpert, name: str, target: np.ndarray) -> Iterator[np.ndarray]:
    """Brings a body's centre to `target` (3,) metres and holds it there."""
    yield from expert.pick(name)
    side = expert.side_of_grasp
    grasp = expert.fingertips(side)
    target = target + grasp[:3, 3] - expert.body(name)[0]
    yield from expert.move(side, target + CLEARANCE_M * UP, grasp[:3, :3])
    yield from expert.move(side, target, grasp[:3, :3])


def _until_closed(expert: BlockExpert, actions: Iterator[np.ndarray], side: str) -> Iterator[np.ndarray]:
    for action in actions:
        yield action
        if expert.opening(side) < 0.05:
            return


def _until_low(
    expert: BlockExpert, actions: Iterator[np.ndarray], side: str, name: str
) -> Iterator[np.ndarray]:
    for action in actions:
        yield action
        if expert.fingertips(side)[2, 3] < expert.body(name)[0][2] + 0.01:
            return


FAULTS: dict[str, Fault] = {
    "knock": Fault(
        Stage.APPROACH,
        DeviationType.SCENE_CHANGE,
        "the gripper came in too low beside {first} and has pushed it away",
        _check_reachable,
    ),
    "misgrasp": Fault(
        Stage.APPROACH,
        DeviationType.WRONG_POSE,
        "the gripper has closed next to {first}, on nothing",
        _misgrasp,
        touches=False,
    ),
    "press": Fault(
        Stage.CONTACT,
        DeviationType.WRONG_POSE,
        "the closed gripper presses on the top of {first}",
        _press,
        touches=False,
    ),
    "drop": Fault(
        Stage.APPROACH,
        DeviationType.STAGE_ROLLBACK,
        "the gripper opened on the way; {first}, which it carried, is on the table below",
        _drop,
    ),
    "astray": Fault(
        Stage.MOVE,
        DeviationType.WRONG_POSE,
        "the gripper holds {first} in the air, away to the side, where it has nothing to do",
        _astray,
    ),
    "wrong_block": Fault(
        Stage.APPROACH,
        DeviationType.WRONG_TARGET,
        "{first} is done; the gripper is around {last}, while {second} comes next",
        _wrong_block,
    ),
    "onto_wrong": Fault(
        Stage.PLACE,
        DeviationType.WRONG_TARGET,
        "the gripper holds {first} on top of {second}, the wrong way round",
        _onto_wrong,
    ),
    "wrong_slot": Fault(
        Stage.PLACE,
        DeviationType.WRONG_TARGET,
        "the gripper holds {first} at the place of {last} in the row",
        _wrong_slot,
    ),
    "beside": Fault(
        Stage.PLACE,
        DeviationType.WRONG_POSE,
        "the gripper holds {held} on the table beside where it belongs",
        _beside,
    ),
    "shove": Fault(
        Stage.PLACE,
        DeviationType.SCENE_CHANGE,
        "with {second} in its fingers, the gripper has pushed {first}, already placed, away",
        _shove,
    ),
    "topple": Fault(
        Stage.APPROACH,
        DeviationType.STAGE_ROLLBACK,
        "the gripper has swept {second}, already placed, off {first}",
        _topple,
    ),
}
