"""How a study is analysed, and what a report shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lerobot_roborecover.analysis.stats.estimators import DRAWS, RowsError
from lerobot_roborecover.analysis.stats.intervals import LEVEL
from lerobot_roborecover.analysis.stats.resampling import SEED
from lerobot_roborecover.analysis.stats.units import ResamplingUnit
from lerobot_roborecover.errors import check_seed
from lerobot_roborecover.utils.options import internal, option


@dataclass(frozen=True)
class ResamplingOptions:
    """How intervals are drawn."""

    scheduled: int | None = option(None, name="trials")
    """Trials scheduled per recovery point; those without a row then count as failures."""
    draws: int = DRAWS
    """Bootstrap draws."""
    seed: int = SEED
    """Seed of the draws."""
    level: float = LEVEL
    """Confidence level."""
    cluster: ResamplingUnit | None = None
    """What intervals and tests take as independent; task: the numbers speak of other tasks like these
    (default: as the paper, trajectory on RoboTwin, else scenario; initial-state trials: first states)."""

    def __post_init__(self):
        check_seed(self.seed)
        if self.draws < 100:
            raise RowsError(
                f"--draws={self.draws} bootstrap draws cannot give an interval; take at least 100"
            )
        if self.cluster is not None and self.cluster not in list(ResamplingUnit):
            raise RowsError(f"--cluster={self.cluster} is not one of {', '.join(ResamplingUnit)}")
        if not 0.5 <= self.level < 1:
            raise RowsError(f"--level={self.level} is not a confidence level from 0.5 to 1")
        if self.scheduled is not None and self.scheduled < 1:
            raise RowsError(f"--trials={self.scheduled} is not a number of trials")


@dataclass(frozen=True)
class Options(ResamplingOptions):
    """How a study is analysed."""

    common: bool = option(False, name="shared-scenarios-only", old=("common",))
    """Rank all policies on the scenarios that all were run on (default: those that were run on all)."""
    baseline: str | None = None
    """Policy that interventions are compared with, where it does not follow from the logs."""
    interventions: tuple[str, ...] = option((), name="intervention", metavar="NAME")
    """Treat this policy as an intervention although no trial of it shows one; may be given again."""
    sequential: bool = internal(False)
    """Whether all pairs are tested so that the logs may be looked at while they grow."""
    planned: Mapping[str, str] | None = internal(None)
    """Units of the planned scenarios by id, for that; by default those that the rows name."""


@dataclass(frozen=True)
class Gallery:
    """What a report's scenario gallery shows, beside outcomes."""

    scenarios: str | None = None
    """The evaluated scenario set (shipped name, folder, Hub id): checks the logs against it.

    Its recorded frames are shown.
    """
    revision: str | None = None
    """Commit, tag or branch of that set on the Hub."""
    render: bool = False
    """Render recovery frames that the set does not hold (runs the simulator)."""
    videos: Sequence[str] = option((), metavar="[NAME=]DIR")
    """Videos of a policy, named after it; may be given again (default: `videos/` beside each log)."""
    videos_mb: int = 64
    """Take in at most so many megabytes of video."""
