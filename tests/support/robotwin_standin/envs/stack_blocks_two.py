from __future__ import annotations

import numpy as np
import sapien

from ._base_task import Base_Task
from .utils import create_box

HALF_M = 0.02
UP = np.array([0, 0, 2 * HALF_M])


class stack_blocks_two(Base_Task):
    """Green on red, both grippers open."""

    def setup_demo(self, **kwargs):
        super()._init_task_env_(**kwargs)

    def load_actors(self):
        for index, color in enumerate([(1, 0, 0), (0, 1, 0)]):
            x = np.random.uniform(0.1, 0.25) * (-1 if index == 0 else 1)
            y, yaw = np.random.uniform(-0.08, 0.05), np.random.uniform(-0.4, 0.4)
            pose = sapien.Pose([x, y, 0.741 + HALF_M], [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
            block = create_box(self, pose, [HALF_M] * 3, color, "box")
            setattr(self, f"block{index + 1}", block)

    def check_success(self):
        red, green = self.block1.get_pose().p, self.block2.get_pose().p
        gap = np.abs(green - red - UP)
        return bool(np.all(gap < [0.025, 0.025, 0.012])) and (
            self.is_left_gripper_open() and self.is_right_gripper_open()
        )
