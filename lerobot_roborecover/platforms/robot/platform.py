"""The platform of recovery points on real robots: it has tasks and actions, and no simulator."""

from __future__ import annotations

from typing import Any

from lerobot_roborecover.platforms.base import Platform
from lerobot_roborecover.platforms.simulator import Simulator, SimulatorError
from lerobot_roborecover.scenario import ScenarioError, Task

_MAX_WIDTH = 64
"""Of an action in a scenario dataset."""
_COMMAND = "`roborecover robot run` evaluates on a robot"


class RobotPlatform(Platform):
    """Any LeRobot robot. Suites are robot types, tasks are the ones that a lab has named."""

    name = "robot"
    title = "a robot"
    action_widths = tuple(range(1, _MAX_WIDTH + 1))
    control_hz = 30.0
    action_bound = float("inf")
    simulated = False
    simulator = ""

    def tasks(self, options: Any = None) -> tuple[Task, ...]:
        """None are known beforehand."""
        return ()

    def check_task(self, task: Task) -> None:
        """Labs name their own."""

    def check_width(self, width: int, where: str) -> None:
        """Refuses actions that no robot has.

        Raises:
            ScenarioError: the width is not within the format's limit.
        """
        if width not in self.action_widths:
            raise ScenarioError(
                f"{where}: prefix actions have width {width}; a robot's have 1 to {_MAX_WIDTH} values"
            )

    def make_simulator(self, **options: Any) -> Simulator:
        """Refuses.

        Raises:
            SimulatorError: always; says which command to use.
        """
        raise SimulatorError(f"a robot is no simulator: {_COMMAND}")

    def env_config(self) -> type:
        """Refuses.

        Raises:
            ScenarioError: always; says which command to use.
        """
        raise ScenarioError(f"platform robot has no env type: {_COMMAND}")


PLATFORM = RobotPlatform()
