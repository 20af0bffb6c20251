"""The lab's simulated operator: clears the table, puts objects back with errors, and judges trials."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_roborecover.robot.console import Answer
from lerobot_roborecover.robot.lab.lab_robot import LabRobot
from lerobot_roborecover.scenario import ScenarioError


class SimulatedOperator:
    """Does what the page asks for, as a person at a real robot would.

    Args:
        robot: the lab's.
        seed: of the placing errors.
        sd_mm: standard deviation of the placing along each axis; by default the robot's configuration says.
        bias_mm: (2,) what each placing is off by on top, as a person who looks from one side would.
        max_tries: placings of one scene before the operator gives up.
    """

    def __init__(
        self,
        robot: LabRobot,
        seed: int = 0,
        sd_mm: float | None = None,
        bias_mm: tuple[float, float] = (0.0, 0.0),
        max_tries: int = 4,
    ):
        self.robot = robot
        self.name = "simulated"
        self._rng = np.random.default_rng(seed)
        self._sd_mm = robot.config.placing_sd_mm if sd_mm is None else sd_mm
        self._bias_mm, self._max_tries = np.array(bias_mm, float), max_tries
        self._tries = self._polls = 0
        self.mark_after = 12
        """Control steps into an episode at which a moment is marked while it is captured."""
        self.true_errors_mm: list[float] = []
        """How far each placing was really off."""

    def clear(self) -> None:
        """Takes the objects off the table, so that the arm can move."""
        self._tries = 0
        self.robot.world.clear()

    def place(self, truth: Mapping[str, Any]) -> None:
        """Puts the objects back.

        Args:
            truth: of the point, as the lab recorded it.

        Raises:
            ScenarioError: the point is not of the simulated lab.
        """
        if "objects" not in truth:
            raise ScenarioError(
                "the point does not say where the lab's objects were: it is of a real robot, or its dataset "
                "was not recorded by `roborecover robot capture` on roborecover_lab. A person has to put "
                "them back"
            )
        self._tries += 1
        offset_mm = self._bias_mm + self._rng.normal(0.0, self._sd_mm, 2)
        turn_rad = float(self._rng.normal(0.0, 0.05)) if self._sd_mm else 0.0
        self.robot.world.place(dict(truth["objects"]), offset_mm / 1000, turn_rad)
        self.true_errors_mm.append(1000 * self.robot.world.distance_m(dict(truth["objects"])))

    def answer(self, screen: str, details: dict[str, Any]) -> Answer | None:
        """What the operator presses on a screen of the run; nothing while a policy runs, until it is done."""
        if screen == "clear":
            self.clear()
            return Answer("go")
        if screen == "place":
            if self.gives_up():
                return Answer("skip")
            self.place(details["truth"])
            return Answer("done")
        if screen == "confirm":
            return Answer("yes")
        if screen == "capturing":
            return self._mark()
        if screen == "running":
            return Answer("success") if self.robot.world.succeeded() else None
        if screen == "verdict":
            return Answer(self.verdict())
        if screen == "next":
            return Answer("go")
        if screen == "finished":
            return Answer("finish")
        return None

    def _mark(self) -> Answer | None:
        """Marks a moment some way into each episode, and ends it a little later."""
        self._polls += 1
        if self._polls == self.mark_after:
            return Answer("mark")
        if self._polls > self.mark_after + 5:
            self._polls = 0
            return Answer("end")
        return None

    def gives_up(self) -> bool:
        """Whether enough placings were tried."""
        return self._tries >= self._max_tries

    def verdict(self) -> str:
        """What a person who looks at the table says: `success` or `failure`."""
        return "success" if self.robot.world.succeeded() else "failure"


class SimulatedHands(SimulatedOperator):
    """Clears the table and puts objects back when the page asks a person to, who presses every button."""

    def answer(self, screen: str, details: dict[str, Any]) -> None:
        """Does what the screen asks for; says nothing."""
        if screen == "clear":
            self.clear()
        if screen == "place":
            self.place(details["truth"])
