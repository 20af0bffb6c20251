"""The simulated lab with a scripted policy, quick enough for tests."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path


def lab_config(folder: Path, **options):
    """Configuration of a lab whose time goes on with its steps."""
    from lerobot_roborecover.robot.lab.config_lab_robot import LabRobotConfig

    values = {"id": "lab", "calibration_dir": folder, "realtime": False, "size": 48, **options}
    return LabRobotConfig(**values)


@contextmanager
def lab(folder: Path, **options):
    """A connected lab."""
    from lerobot_roborecover.robot.connection import connected

    with connected(lab_config(folder, **options)) as robot:
        yield robot


def scripted(folder: Path, **options) -> str:
    """A checkpoint of the lab's scripted policy."""
    from lerobot_roborecover.robot.lab.scripted import save_scripted

    return str(save_scripted(folder, **options))
