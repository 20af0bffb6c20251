"""The module LeRobot imports: it has the distribution's own name."""

import logging
import sys

from lerobot_roborecover.utils.lerobot_versions import installed_problem, takes_strategies

# Before the rest: where LeRobot has changed too much, LeRobot itself only says that importing this failed.
if note := installed_problem():
    logging.getLogger(__name__).warning(note)

import lerobot_roborecover.plugin
import lerobot_roborecover.robot.lab.config_lab_robot
import lerobot_roborecover.robot.lab.configuration_lab_pusher

# `lerobot-rollout` has imported this before it asks for plugins; the others need not pay for it.
if "lerobot.rollout" in sys.modules and takes_strategies():
    import lerobot_roborecover.robot.strategy  # noqa: F401 - registers its type
