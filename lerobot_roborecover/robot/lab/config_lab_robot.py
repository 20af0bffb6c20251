"""`--robot.type=roborecover_lab`: LeRobot finds the robot itself in the module beside this one."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("roborecover_lab")
@dataclass
class LabRobotConfig(RobotConfig):
    """The simulated lab's robot."""

    world: str = "table"
    """`table` (a point mass and a puck; milliseconds a step), `so101` (extra `so101`) or `metaworld`."""
    task: str = ""
    """Task of the world; empty takes its first."""
    seed: int = 0
    """Seed of the first scene and of all noise; a new scene takes the next one."""
    size: int = 96
    """Rows and columns of the cameras' pictures."""
    tags: bool = False
    """Fiducial tags lie on the object and on the table."""
    joint_noise: float = 0.2
    """Standard deviation of measured positions, in the joints' units."""
    image_noise: float = 2.0
    """Standard deviation of pixel values, of 255."""
    backlash: float = 0.5
    """Play of the drives, in the joints' units."""
    latency_steps: int = 1
    """Control steps by which pictures are late."""
    max_relative_target: float | None = None
    """Largest step of a target from the present position, in the joints' units."""
    realtime: bool = True
    """Takes the wall's time; else time goes on with the steps."""
    placing_sd_mm: float = 4.0
    """Standard deviation of the simulated operator's placing, along each axis of the table."""
    unplug_at_step: int = 0
    """The connection breaks at this step after connecting; 0 never."""
    freeze_at_step: int = 0
    """The first camera gives the same picture from this step on; 0 never."""
