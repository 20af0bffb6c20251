"""How long a run should take, worked out from what a step, a picture and an inference are taken to cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.scenario import Scenario


@dataclass(frozen=True)
class Costs:
    """Parameters of the estimate, none of them measured: put in those of `roborecover check policy`."""

    step_ms: float = 12.0
    """For the expected hours alone.

    Of a simulator's step, without picture. LIBERO's, on one core (docs/log/performance.md).
    """
    picture_ms: float = 20.0
    """For the expected hours alone.

    Of all cameras, whenever the policy looks. A guess for two cameras on a GPU.
    """
    inference_ms: float = 100.0
    """For the expected hours alone.

    Of a batch. A guess for a model of 3 to 4 billion weights on a current GPU.
    """
    slots: int = 16
    """For the expected hours alone.

    Simulators at once, each with a core.
    """
    batch: float = 8.0
    """For the expected hours alone.

    Observations in an inference, on average: half of the slots wait while the others step.
    """

    def __post_init__(self):
        for name in ("step_ms", "picture_ms", "inference_ms"):
            if not 0 <= getattr(self, name) < 1e6:
                raise OptionError(f"{name}={getattr(self, name)}: milliseconds from 0")
        if self.slots < 1 or self.batch < 1:
            raise OptionError(f"slots={self.slots}, batch={self.batch}: at least 1 of each")


@dataclass(frozen=True)
class RunLength:
    """An arm's work where no trial ends early, so at most."""

    trials: int
    steps: int
    """Steps of policies, all trials together."""
    looks: int
    """Observations that a policy gets."""
    simulator_h: float
    policy_h: float

    @property
    def hours(self) -> float:
        """Whichever of the two takes longer; they work at the same time."""
        return max(self.simulator_h, self.policy_h)


def run_length(
    scenarios: Sequence[Scenario], trials: int, executed: int, costs: Costs, *, replay: bool
) -> RunLength:
    """Hours of an arm.

    Args:
        scenarios: with their horizons and prefixes.
        trials: per scenario.
        executed: actions per inference.
        costs: of a step, a picture, an inference.
        replay: whether prefixes are replayed: once per scenario, later trials start from its snapshot.
    """
    if executed < 1:
        raise OptionError(f"executed={executed}: at least one action per inference")
    steps = trials * sum(s.task.horizon for s in scenarios)
    looks = trials * sum(-(-s.task.horizon // executed) for s in scenarios)
    replayed = sum(len(s.prefix) for s in scenarios) if replay else 0
    simulator_s = ((steps + replayed) * costs.step_ms + looks * costs.picture_ms) / 1e3 / costs.slots
    policy_s = looks / costs.batch * costs.inference_ms / 1e3
    return RunLength(trials * len(scenarios), steps, looks, simulator_s / 3600, policy_s / 3600)
