"""Recovery points of a robot that was never there."""

from __future__ import annotations

import numpy as np

from lerobot_roborecover.robot.points import make_point
from lerobot_roborecover.scenario import Scenario

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


def pictures_of(seed: int, count: int = 3) -> dict[str, np.ndarray]:
    """(count, 24, 32, 3) uint8 of one camera."""
    return {"top": np.random.default_rng(seed).integers(0, 255, (count, 24, 32, 3), np.uint8)}


def made_point(
    name: str,
    *,
    seed: int = 0,
    joints: float = 0.0,
    picture: int = 0,
    calibration_sha256: str = "",
    **changes,
) -> Scenario:
    """A point whose joints are `joints` off those of its seed, seen in the pictures of seed + `picture`."""
    rng = np.random.default_rng(seed)
    approach = rng.uniform(-40, 40, (8, len(JOINTS))).round(3) + joints
    values = {
        "id": name, "task_name": "cube in bowl", "instruction": "put the cube into the bowl",
        "actions": rng.uniform(-40, 40, (20, len(JOINTS))),
        "labels": {"stage": "Approach", "deviation": "Wrong Pose", "source": "natural"},
        "robot_type": "so101_follower", "calibration_sha256": calibration_sha256,
        "joints": dict(zip(JOINTS, approach[-1].tolist(), strict=True)),
        "units": dict.fromkeys(JOINTS, "deg"),
        "pictures": {n: stack[-1] for n, stack in pictures_of(seed + picture).items()}, "fps": 30.0,
        "time_limit_s": 10.0, "approach": approach, "dataset": "lab/rollout_cube", "episode": 3,
        "quasi_static": True,
    }  # fmt: skip
    return make_point(**{**values, **changes})
