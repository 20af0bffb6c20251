"""Configuration of the distance from training states."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs.rewards import RewardModelConfig

from lerobot_roborecover.policies.detectors.base import DetectorConfig

METHODS = ("knn", "mahalanobis")


@RewardModelConfig.register_subclass("roborecover_state_distance")
@dataclass
class RoboRecoverStateDistanceConfig(DetectorConfig):
    """How far the state is from the states that the policy was trained on."""

    keys: str = "observation.state,observation.environment_state"
    """Vectors that are compared, with commas between."""
    method: str = "knn"
    """`knn`: distance to the k-th nearest training state; `mahalanobis`: from their mean, by their
    covariance. Both on standardised vectors."""
    k: int = 5
    """Neighbour that counts, of `knn`."""
    by_task: bool = True
    """Compare with training states of the same instruction; an instruction that is not among them, with
    all."""
    max_states: int = 20_000
    """Training states that are kept, drawn evenly."""
    seed: int = 0
    """Seed of that draw."""
    instructions: list[str] = field(default_factory=list)
    """Instructions of the training states; filled when they are fitted."""

    def check(self) -> None:
        """A method, a neighbour and something to look at."""
        if self.method not in METHODS:
            raise self.refuse("method", " or ".join(METHODS))
        if self.k < 1:
            raise self.refuse("k", "at least 1")
        if self.max_states < 2:
            raise self.refuse("max_states", "at least 2")
        if not self.keys.strip(", "):
            raise self.refuse("keys", "one observation key or several")

    @property
    def key_list(self) -> list[str]:
        return [k.strip() for k in self.keys.split(",") if k.strip()]
