"""The module LeRobot imports: it has the distribution's own name."""

import logging

from lerobot_roborecover.platforms.versions import lerobot_note

# Before the rest: where LeRobot has changed too much, LeRobot itself only says that importing this failed.
if note := lerobot_note():
    logging.getLogger(__name__).warning(note)

import lerobot_roborecover.plugin
import lerobot_roborecover.robot.lab.config_lab_robot
import lerobot_roborecover.robot.lab.configuration_lab_pusher  # noqa: F401 - register types
