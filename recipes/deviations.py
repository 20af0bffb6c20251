"""Deliberate deviations, one a cell: what a person at the controls would do to get there.

Each drives a task by what a `Hand` sees of it (hand, object, goal) to a state that belongs to one cell.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.scenario import DeviationType, Stage

OPEN, CLOSED = -1.0, 1.0
_ARRIVED_M = 0.015


class Fumbled(Exception):
    """The deviation did not come about; another start may do."""


class Hand(ABC):
    """Small motions out of which deviations are made.

    Args:
        rng: of their details.
    """

    gain: float
    """Command per metre that is left to go."""
    support_m = 0.0
    """Height of what everything stands on."""
    travel_m = 0.18
    """How high above that the hand travels."""
    near_m = 0.1
    """An object this near to its place has nearly arrived."""
    settle_steps = 8
    """For how long an object that is put down is still held."""
    aside_m: tuple[float, float] | None = None
    """How far beside its place, at least and at most, it is let go so as not to arrive; None: there."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self.start = self.object()

    @abstractmethod
    def at(self) -> np.ndarray:
        """(3,) metres: between the fingertips."""

    @abstractmethod
    def object(self) -> np.ndarray:
        """(3,) metres: the handled point."""

    @abstractmethod
    def goal(self) -> np.ndarray:
        """(3,) metres: where it belongs."""

    @abstractmethod
    def other(self) -> np.ndarray:
        """(3,) metres: a part that is not to be handled.

        Raises:
            Fumbled: there is none.
        """

    @abstractmethod
    def target(self) -> np.ndarray:
        """(3,) metres: the movable thing that the object is to be brought to.

        Raises:
            Fumbled: there is none.
        """

    @abstractmethod
    def over_m(self) -> float:
        """From the handled point up to where closing fingers just miss it, metres."""

    @abstractmethod
    def carried(self, far_m: float) -> bool:
        """Whether the object is in the grasp, and has gone along with the hand for so far."""

    @abstractmethod
    def move(self, velocity: np.ndarray, grip: float) -> bool:
        """One command of the hand; whether the task is solved.

        Args:
            velocity: (3,), clipped to [-1, 1].
            grip: `OPEN` to `CLOSED`.
        """

    @abstractmethod
    def follow(self, t: int) -> bool:
        """One action of the task's scripted controller; whether the task is solved."""

    def act(self, velocity: np.ndarray, grip: float) -> None:
        """One command.

        Raises:
            Fumbled: it solved the task.
        """
        if self.move(velocity, grip):
            raise Fumbled("the task was solved on the way")

    def go(self, target: np.ndarray, grip: float, most: int = 60) -> None:
        """Towards a point, until there or no longer getting on."""
        for _ in range(most):
            error = np.asarray(target) - self.at()
            if np.linalg.norm(error) < _ARRIVED_M:
                return
            self.act(self.gain * error, grip)

    def hold(self, steps: int, grip: float) -> None:
        """Stays where it is."""
        for _ in range(steps):
            self.act(np.zeros(3), grip)

    def carry(self, when: Callable[[], bool], most: int = 150) -> None:
        """The scripted controller, until a condition holds.

        Raises:
            Fumbled: it never did.
        """
        for t in range(most):
            if when():
                return
            if self.follow(t):
                raise Fumbled("the task was solved on the way")
        raise Fumbled("the scripted controller did not get that far")

    def grasp(self, far_m: float = 0.03) -> None:
        """The scripted controller, until the object has gone along with the hand for so far."""
        self.carry(lambda: self.carried(far_m))

    def up(self, grip: float, height_m: float) -> None:
        """Rises to a height."""
        self.go(np.array([*self.at()[:2], height_m]), grip)

    def above(self) -> float:
        """Height at which the hand travels, metres."""
        return self.support_m + self.travel_m

    def sideways(self, low_m: float, high_m: float) -> np.ndarray:
        """(3,) a random horizontal offset, rather to the sides than forth and back."""
        side = self.rng.choice([-1.0, 1.0])
        distance, angle = self.rng.uniform(low_m, high_m), self.rng.uniform(-0.6, 0.6)
        return distance * np.array([side * np.cos(angle), np.sin(angle), 0.0])


def wrong_part(hand: Hand) -> None:
    """Goes to a part that is not to be handled, and presses it."""
    part = hand.other()
    hand.up(CLOSED, max(hand.above(), part[2] + 0.1))
    hand.go(part + np.array([0.0, -0.06, 0.08]), CLOSED)
    hand.go(part + np.array([0.0, -0.02, 0.0]), CLOSED, 30)
    for _ in range(30):
        if np.linalg.norm(hand.other() - part) > 0.02:
            break
        hand.act(np.array([0.0, 0.7, -0.2]), CLOSED)


def beside(hand: Hand) -> None:
    """Comes down beside the object, too far away to touch it."""
    spot = hand.object() + hand.sideways(0.14, 0.2)
    hand.go(np.array([*spot[:2], hand.above()]), OPEN)
    hand.go(np.array([*spot[:2], max(hand.object()[2] + 0.03, hand.support_m + 0.06)]), OPEN)


def dropped(hand: Hand) -> None:
    """Takes the object, lets it fall on the way, and goes on without it."""
    hand.grasp()
    hand.go(hand.at() + hand.sideways(0.05, 0.1) + np.array([0.0, 0.0, 0.05]), CLOSED, 25)
    hand.hold(12, OPEN)
    hand.up(OPEN, hand.above() + 0.04)
    hand.go(hand.at() + hand.sideways(0.06, 0.1), OPEN, 30)


def knocked(hand: Hand) -> None:
    """Sweeps the object aside with a closed gripper, and rises."""
    thing, aside = hand.object(), hand.sideways(0.1, 0.12)
    height = max(thing[2], hand.support_m + 0.03)
    hand.go(np.array([*(thing - aside)[:2], hand.above()]), CLOSED)
    hand.go(np.array([*(thing - aside)[:2], height]), CLOSED)
    hand.go(np.array([*(thing + 0.5 * aside)[:2], height]), CLOSED, 30)
    hand.up(OPEN, hand.above() + 0.04)


def too_high(hand: Hand) -> None:
    """Closes the gripper just above the object, beside its middle."""
    spot = hand.object() + hand.sideways(0.015, 0.03)
    hand.go(np.array([*spot[:2], hand.above()]), OPEN)
    hand.go(np.array([*spot[:2], hand.object()[2] + hand.over_m()]), OPEN)
    hand.hold(12, CLOSED)


def astray(hand: Hand) -> None:
    """Carries the object off its way, and stops with it in the grasp."""
    hand.grasp()
    hand.go(hand.at() + hand.sideways(0.06, 0.1) + np.array([0.0, 0.0, 0.06]), CLOSED, 30)


def wrong_place(hand: Hand) -> None:
    """Puts the object down where it does not belong, and stays there."""
    hand.grasp()
    away = hand.start[:2] + hand.sideways(0.1, 0.14)[:2]
    hand.go(np.array([*away, hand.at()[2]]), CLOSED, 40)
    low = hand.at() - np.array([0.0, 0.0, max(hand.object()[2] - hand.start[2], 0.0)])
    hand.go(low, CLOSED, 25)
    hand.hold(hand.settle_steps, CLOSED)
    hand.hold(14, OPEN)


def nearly(hand: Hand) -> None:
    """Brings the object close to its place, and stops beside it."""

    def near() -> bool:
        return bool(np.linalg.norm(hand.object() - hand.goal()) < hand.near_m)

    hand.grasp()
    hand.carry(near)
    hand.go(hand.at() + hand.sideways(0.02, 0.03), CLOSED, 15)


def fallen_beside(hand: Hand) -> None:
    """Lets the object fall just before its place, and rises."""

    def near() -> bool:
        return bool(np.linalg.norm(hand.object() - hand.goal()) < hand.near_m)

    hand.grasp()
    hand.carry(near)
    if hand.aside_m is not None:
        hand.go(hand.at() + hand.sideways(*hand.aside_m), CLOSED, 15)
    hand.hold(12, OPEN)
    hand.up(OPEN, hand.at()[2] + 0.1)


def place_disturbed(hand: Hand) -> None:
    """With the object in the grasp, pushes what it is to be brought to out of the way."""
    hand.grasp()
    target = hand.target()
    offset = hand.object() - hand.at()
    beside_it = target - offset + np.array([0.02, 0.14, 0.0])
    hand.go(np.array([*beside_it[:2], hand.at()[2] + 0.08]), CLOSED, 50)
    hand.go(np.array([*beside_it[:2], target[2] - 0.05]), CLOSED, 30)
    for _ in range(40):
        if np.linalg.norm(hand.target() - target) > 0.05:
            break
        hand.act(np.array([0.0, -0.8, 0.0]), CLOSED)
    hand.go(hand.at() + np.array([-0.04, 0.03, 0.0]), CLOSED, 12)


@dataclass(frozen=True)
class Deviation:
    """One way into a cell."""

    stage: Stage
    deviation: DeviationType
    make: Callable[[Hand], None]
    grip: float
    """Gripper while stopped."""


DEVIATIONS: dict[str, Deviation] = {
    "wrong-part": Deviation(Stage.APPROACH, DeviationType.WRONG_TARGET, wrong_part, CLOSED),
    "beside": Deviation(Stage.APPROACH, DeviationType.WRONG_POSE, beside, OPEN),
    "dropped": Deviation(Stage.APPROACH, DeviationType.STAGE_ROLLBACK, dropped, OPEN),
    "knocked": Deviation(Stage.APPROACH, DeviationType.SCENE_CHANGE, knocked, OPEN),
    "too-high": Deviation(Stage.CONTACT, DeviationType.WRONG_POSE, too_high, CLOSED),
    "astray": Deviation(Stage.MOVE, DeviationType.WRONG_POSE, astray, CLOSED),
    "wrong-place": Deviation(Stage.PLACE, DeviationType.WRONG_TARGET, wrong_place, OPEN),
    "nearly": Deviation(Stage.PLACE, DeviationType.WRONG_POSE, nearly, CLOSED),
    "fallen-beside": Deviation(Stage.PLACE, DeviationType.SCENE_CHANGE, fallen_beside, OPEN),
    "place-disturbed": Deviation(Stage.PLACE, DeviationType.SCENE_CHANGE, place_disturbed, CLOSED),
}
"""By name."""
