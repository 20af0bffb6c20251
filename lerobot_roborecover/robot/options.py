"""Options of `robot points`, importable without LeRobot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.options import option


@dataclass(frozen=True, kw_only=True)
class RobotPointsOptions:
    """Which moments of which dataset become points, and their labels."""

    dataset: Path = option(positional=True)
    """Folder of a LeRobotDataset with joint positions and cameras."""
    out: Path
    """Folder of the set of recovery points; an earlier set is replaced."""
    at: tuple[str, ...] = option((), metavar="EPISODE:FRAME[:STAGE:TYPE]")
    """Moments; without any, those that were marked while the dataset was captured."""
    stage: str = "Approach"
    """Recovery stage of moments that name none."""
    deviation: str = option("Wrong Pose", name="type")
    """Deviation type of moments that name none."""
    quasi_static: bool = False
    """You have looked: at these moments nothing is falling, sliding, or held by friction alone."""
    time_limit: float = option(30.0, metavar="SECONDS")
    """Time limit of a trial."""
    source_policy: str = ""
    """Who drove the robot in the episodes."""
    annotators: tuple[str, ...] = option((), name="annotator", metavar="NAME")
    """Serves the annotation page, where each annotator marks alone and blind; may be given again."""
    votes_needed: int | None = option(None, metavar="N")
    """Makes the points from so many annotators' votes: majority of stage and type, median frame."""
    port: int = 8731
    """Port of the annotation page; 0 takes a free one."""
    calibration: Path | None = option(None, metavar="FILE")
    """LeRobot's calibration file of the robot, for a dataset that this package did not record."""
