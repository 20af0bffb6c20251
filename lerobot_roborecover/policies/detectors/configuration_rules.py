"""Configurations of detectors that follow a rule: nothing is fitted but their threshold."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs.rewards import RewardModelConfig

from lerobot_roborecover.policies.detectors.base import DetectorConfig

TRUTHS = ("recovery_point", "outcome")


@RewardModelConfig.register_subclass("roborecover_constant")
@dataclass
class RoboRecoverConstantConfig(DetectorConfig):
    """Alarms at a constant rate, whatever it sees: what any detector must beat."""

    rate: float = 0.01
    """Chance at each step, from 0 to 1."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.threshold is None:
            self.threshold = 1.0 - self.rate

    def check(self) -> None:
        if not 0.0 <= self.rate <= 1.0:
            raise self.refuse("rate", "from 0 to 1")


@RewardModelConfig.register_subclass("roborecover_elapsed")
@dataclass
class RoboRecoverElapsedConfig(DetectorConfig):
    """Steps since the watch began: a plain time-out. Failures last longer than successes, which is all that
    it knows."""

    steps: int = 200
    """Steps that count as 1."""

    def check(self) -> None:
        """At least one step."""
        if self.steps < 1:
            raise self.refuse("steps", "at least 1")


@RewardModelConfig.register_subclass("roborecover_no_progress")
@dataclass
class RoboRecoverNoProgressConfig(DetectorConfig):
    """A time-out of standing still: how little the state has moved within the last steps."""

    keys: str = "observation.state"
    """Vectors that are to move, with commas between."""
    steps: int = 30
    """Window; the score is 0 until so many steps have been seen."""
    scale: float = 0.05
    """Way in the state's own units at which the score is one half."""

    def check(self) -> None:
        """A window, a way, and something to look at."""
        if self.steps < 1:
            raise self.refuse("steps", "at least 1")
        if self.scale <= 0:
            raise self.refuse("scale", "above 0")
        if not self.keys.strip(", "):
            raise self.refuse("keys", "one observation key or several")


@RewardModelConfig.register_subclass("roborecover_oracle")
@dataclass
class RoboRecoverOracleConfig(DetectorConfig):
    """Knows the answer: the best that any detector can do by that truth."""

    truth: str = "outcome"
    """`recovery_point`: 1 from it on; `outcome`: 1 where the policy does not recover by itself, which is
    known only after the trial."""
    threshold: float | None = 0.5

    def check(self) -> None:
        if self.truth not in TRUTHS:
            raise self.refuse("truth", " or ".join(TRUTHS))
