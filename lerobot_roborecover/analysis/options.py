"""How a study is analysed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from lerobot_roborecover.analysis.stats.estimators import DRAWS, RowsError
from lerobot_roborecover.analysis.stats.intervals import LEVEL
from lerobot_roborecover.analysis.stats.resampling import SEED
from lerobot_roborecover.analysis.stats.units import ResamplingUnit
from lerobot_roborecover.errors import check_seed


@dataclass(frozen=True)
class Options:
    """How a study is analysed."""

    draws: int = DRAWS
    seed: int = SEED
    level: float = LEVEL
    scheduled: int | None = None
    """Trials every scenario was to have from each recovery point; those without a row count as failures."""
    baseline: str | None = None
    """Direct control that interventions are compared with; by default the same policy, or the only one."""
    interventions: tuple[str, ...] = ()
    """Policies to treat as interventions although none of their trials shows one."""
    cluster: ResamplingUnit | None = None
    """What intervals and tests take as independent; by default what the paper resamples on the platform."""
    common: bool = False
    """Rank all policies, on the scenarios common to all; by default those that are complete."""
    sequential: bool = False
    """Whether all pairs are tested so that the logs may be looked at while they grow."""
    planned: Mapping[str, str] | None = None
    """Units of the planned scenarios by id, for that; by default those that the rows name."""

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
