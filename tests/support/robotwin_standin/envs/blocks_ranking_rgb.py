from __future__ import annotations

import numpy as np
import sapien

from ._base_task import Base_Task
from .utils import create_box

HALF_M = 0.02


class blocks_ranking_rgb(Base_Task):
    """Red, green and blue from left to right, side by side."""

    def setup_demo(self, **kwargs):
        super()._init_task_env_(**kwargs)

    def load_actors(self):
        columns = np.random.permutation([-0.2, 0.0, 0.2])
        for index, color in enumerate([(1, 0, 0), (0, 1, 0), (0, 0, 1)]):
            y = np.random.uniform(-0.08, 0.05)
            pose = sapien.Pose([columns[index], y, 0.741 + HALF_M])
            setattr(self, f"block{index + 1}", create_box(self, pose, [HALF_M] * 3, color, "box"))

    def check_success(self):
        red, green, blue = (getattr(self, f"block{i}").get_pose().p for i in (1, 2, 3))
        ordered = red[0] < green[0] < blue[0]
        close = all(
            np.abs(a - b)[0] < 0.13 and np.abs(a - b)[1] < 0.03 for a, b in ((red, green), (green, blue))
        )
        return bool(ordered and close) and self.is_left_gripper_open() and self.is_right_gripper_open()
