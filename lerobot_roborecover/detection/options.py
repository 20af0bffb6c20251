"""What a comparison of detectors is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.detection.trials import TrialSource
from lerobot_roborecover.errors import check_seed
from lerobot_roborecover.utils.options import option


@dataclass(frozen=True, kw_only=True)
class DetectionRequest:
    """What is compared, and on what."""

    detectors: Sequence[str] = option(
        (), name="detector", metavar="[NAME=]WHAT[,OPTION=VALUE...]", show_default=False
    )
    """A checkpoint of a monitor, of a saved detector or of a LeRobot reward model; or chunk_disagreement,
    constant, elapsed, no_progress, oracle, policy_features, recovery_gain, state_distance; may be given
    again."""
    source: TrialSource = field(default_factory=TrialSource)
    split: str = "test"
    """Scenarios that are measured on."""
    fit_split: str = "train"
    """Scenarios whose trials policy_features and state_distance are fitted to."""
    fit_select: str | None = None
    """The same of --fit-split alone (as --select)."""
    training_data: Path | None = option(None, metavar="DIR")
    """LeRobotDataset that the policy was trained on, for state_distance (successful clean rollouts)."""
    forks: Path | None = option(None, metavar="LOG")
    """Log of `roborecover detect fork` on trials of the policy, for recovery_gain."""
    alpha: float = 0.1
    """Chance of a false alarm in a clean rollout that conformal thresholds allow."""
    against: Sequence[str] = option((), metavar="NAME")
    """Test pairs with this detector alone; may be given again (all pairs)."""
    device: str | None = None
    """Where the policy and the detectors run."""
    base_model: str | None = None
    """Base of a Qwen3-VL monitor, where its checkpoint names another place."""
    on_training_scenarios: bool = False
    """Compare also on scenarios that a monitor was trained on: says nothing about others."""
    seed: int = 0
    """Seed of the scenarios' halves in the frame strips."""
    level: float = 0.95
    """Confidence level."""

    def __post_init__(self):
        check_seed(self.seed)
