"""`roborecover robot points`."""

from __future__ import annotations

from lerobot_roborecover.robot.options import RobotPointsOptions

HELP = "Make recovery points of a robot's recorded episodes: where people have marked, or at frames you name."


OPTIONS = RobotPointsOptions


def run(options: RobotPointsOptions) -> int:
    from lerobot_roborecover.robot.make_points import make_points

    return make_points(options, print)
