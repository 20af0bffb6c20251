"""The module LeRobot imports: it has the distribution's own name."""

import logging

from lerobot_roborecover.utils.lerobot_versions import installed_problem

# Before the rest: where LeRobot has changed too much, LeRobot itself only says that importing this failed.
if note := installed_problem():
    logging.getLogger(__name__).warning(note)

import lerobot_roborecover.plugin
import lerobot_roborecover.robot.lab.config_lab_robot
import lerobot_roborecover.robot.lab.configuration_lab_pusher  # noqa: F401 - register types
