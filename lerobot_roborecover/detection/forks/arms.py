"""What can happen at a fork: the arms."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.analysis.stats.fork_gain import CONTINUE
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.policies.interventions.options import POLICY_TYPE

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig

ARMS = {
    CONTINUE: "the same policy, with what it remembers",
    "fresh": "the same policy with fresh history",
    "rollback:K": "K steps back, and the same policy with fresh history",
    "correction:CHECKPOINT": "a correction policy for some steps, then the same policy with fresh history",
    "policy:CHECKPOINT": "another policy",
    "human:MODULE:FUNCTION": "a person, through a controller (docs/interventions.md)",
}
"""In the words of `--arm`."""
MAX_BACK = 100_000


@dataclass(frozen=True)
class ForkArm:
    kind: str
    """`continue`, `fresh`, `rollback`, `correction`, `policy` or `human`."""
    value: str = ""
    """What stands after its colon."""

    @property
    def teacher_forced(self) -> bool:
        """Whether the policy's history is that of the logged trial."""
        return self.kind == CONTINUE

    @property
    def back(self) -> int:
        """Steps that it goes back first."""
        return int(self.value) if self.kind == "rollback" else 0

    @property
    def label(self) -> str:
        """Its name in rows and tables; checkpoints by their content."""
        from lerobot_roborecover.policies.identity import policy_identity

        value = policy_identity(self.value) if self.kind in ("correction", "policy") else self.value
        return f"{self.kind}:{value}" if value else self.kind

    def config(self, base: PreTrainedConfig, correction_steps: int) -> PreTrainedConfig:
        """The policy that acts in it.

        Args:
            base: the policy of the logged trials.
            correction_steps: steps of a correction policy.

        Raises:
            OptionError: there is no such checkpoint.
        """
        from lerobot_roborecover.evaluation.loading import policy_config
        from lerobot_roborecover.policies.interventions.configuration_intervention import (
            MemberConfig,
            RoboRecoverInterventionConfig,
        )

        if self.kind == "policy":
            return policy_config(self.value, device=base.device)
        if self.kind not in ("correction", "human"):
            return base
        if base.pretrained_path is None or base.type == POLICY_TYPE:
            raise OptionError(f"--arm={self.kind}:{self.value}: needs a base policy that is a checkpoint")
        config = RoboRecoverInterventionConfig(
            base=MemberConfig(str(base.pretrained_path)),
            correction=MemberConfig(self.value if self.kind == "correction" else ""),
            mode=self.kind,
            correction_steps=correction_steps,
            controller=self.value if self.kind == "human" else "",
            device=base.device,
        )
        config.check()
        return config


def parse_arm(text: str) -> ForkArm:
    """An arm in the words of `--arm`.

    Raises:
        OptionError: it is none; says which there are.
    """
    kind, _, value = text.partition(":")
    named = {name.partition(":")[0]: name for name in ARMS}
    if kind not in named or (":" in named[kind]) != bool(value):
        raise OptionError(f"--arm={text}: not one of {', '.join(ARMS)}")
    if kind == "rollback" and not (value.isdecimal() and 1 <= int(value) <= MAX_BACK):
        raise OptionError(f"--arm={text}: goes back a number of steps from 1 to {MAX_BACK}")
    if kind in ("correction", "policy") and value.startswith(("~", ".")):
        value = str(Path(value).expanduser())
    return ForkArm(kind, value)
