"""Plans that turn the arm's first joint by `TURN_RAD`, and fail for goals below the arm's base."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import torch

TURN_RAD = 0.05
SAMPLES = 60
MADE = []
"""Robot files of the planners made so far."""


class MotionGenConfig:
    @staticmethod
    def load_from_robot_config(robot_file, world_config, **options):
        assert Path(robot_file).is_file(), robot_file
        return robot_file


class MotionGenPlanConfig:
    def __init__(self, max_attempts=1):
        self.max_attempts = max_attempts


class PoseCostMetric:
    pass


class MotionGen:
    def __init__(self, config):
        MADE.append(config)

    def warmup(self, **options):
        pass

    def reset(self, **options):
        pass

    def plan_single(self, start, goal, config):
        turned = torch.linspace(0, TURN_RAD, SAMPLES, dtype=torch.float64)
        position = start.position.double().repeat(SAMPLES, 1)
        position[:, 0] += turned
        plan = SimpleNamespace(position=position, velocity=torch.zeros_like(position))
        return SimpleNamespace(success=torch.tensor(goal[2] > 0), interpolated_plan=plan)
