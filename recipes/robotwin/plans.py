"""How the scripted controller solves each task that it knows, from wherever things are."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from recipes.robotwin.expert import TABLE_M, THERE_M, BlockExpert
from recipes.robotwin.handover import set_down, take

ORDERS = {
    "stack_blocks_two": ("block1", "block2"),
    "stack_blocks_three": ("block1", "block2", "block3"),
    "blocks_ranking_rgb": ("block1", "block2", "block3"),
    "blocks_ranking_size": ("block1", "block2", "block3"),
    "handover_block": ("box",),
}
"""Bodies of a task in the order in which the controller handles them."""

INSTRUCTIONS = {
    "stack_blocks_two": "Move the red block to the center, then stack the green block on top of it.",
    "stack_blocks_three": "Move the red block, the green block, and the blue block to the center, then stack "
    "the blue block on the green block and the green block on the red block.",
    "blocks_ranking_rgb": "Arrange the red block, the green block, and the blue block in a row with the red "
    "block on the left, the green block in the middle, and the blue block on the right.",
    "blocks_ranking_size": "Move the blocks to the center of the table and arrange them from largest to "
    "smallest, from left to right.",
    "handover_block": "Grab the red block with the left arm, switch to the right arm, and set it on the blue "
    "pad.",
}
"""In the words of RoboTwin's own templates."""

ROW_XY_M = {"block1": (-0.11, -0.15), "block2": (0.0, -0.15), "block3": (0.11, -0.15)}
"""Places of a row, left to right: neighbours less than RoboTwin's 0.13 m apart, with room for fingers."""
PLACING_M = 0.003
"""Above its support, a body is let go."""
TASKS = tuple(ORDERS)


def goal(expert: BlockExpert, task: str, name: str) -> np.ndarray:
    """(3,) metres: where a body's centre belongs, as the scene is now."""
    half = expert.half_height(name)
    if task.startswith("blocks_ranking"):
        return np.array([*ROW_XY_M[name], TABLE_M + half + PLACING_M])
    if task == "handover_block":
        pad = expert.simulator.robotwin_task.task.target_box.get_functional_point(1, "pose").p
        return np.array([*pad[:2], pad[2] + half + PLACING_M])
    order = ORDERS[task]
    level = order.index(name)
    if level == 0:
        return np.array([*expert.free_place(name), TABLE_M + half + PLACING_M])
    below, _ = expert.body(order[level - 1])
    return np.array([*below[:2], below[2] + 2 * half + PLACING_M + 0.001])


def is_there(expert: BlockExpert, task: str, name: str) -> bool:
    """Whether a body stands where it belongs."""
    return float(np.linalg.norm(expert.body(name)[0] - goal(expert, task, name))) < THERE_M


def put(expert: BlockExpert, task: str, name: str) -> Iterator[np.ndarray]:
    """Actions that bring one body where it belongs."""
    if task == "handover_block":
        yield from take(expert, name)
        yield from set_down(expert, name, goal(expert, task, name))
        return
    yield from expert.pick_and_place(name, goal(expert, task, name))


def solve(expert: BlockExpert, task: str) -> Iterator[np.ndarray]:
    """Actions that solve a task, from folded arms."""
    for name in ORDERS[task]:
        if not is_there(expert, task, name):
            yield from put(expert, task, name)


def recover(expert: BlockExpert, task: str) -> Iterator[np.ndarray]:
    """Actions that solve a task from wherever things are: let go, fold the arms away, then `solve`."""
    yield from expert.let_go()
    yield from solve(expert, task)
