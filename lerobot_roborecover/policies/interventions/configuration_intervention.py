"""Options of the composite policy: `--policy.type=roborecover_intervention`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import OptimizerConfig

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.policies.interventions.options import MODES, POLICY_TYPE
from lerobot_roborecover.policies.not_trained import NotTrained
from lerobot_roborecover.utils.options import move_old_fields


@dataclass
class MemberConfig:
    """A checkpoint that takes part."""

    path: str = ""
    """Folder or Hub id."""
    revision: str | None = None
    """Commit, tag or branch of a Hub checkpoint."""
    n_action_steps: int | None = None
    """Actions executed per inference, where not as saved."""
    rename_map: dict[str, str] = field(default_factory=dict)
    """From the environment's observation names to the checkpoint's."""


@dataclass
class MonitorConfig:
    """The recovery monitor, or any other detector."""

    path: str = ""
    """Folder or Hub id; or a kind of detector with its options, e.g. `no_progress,steps=30,threshold=0.9`
    (docs/detectors.md)."""
    revision: str | None = None
    """Commit, tag or branch of a Hub checkpoint."""
    threshold: float | None = None
    """Smallest score that triggers, where not the monitor's own."""
    base_model: str = ""
    """Backbone of a monitor that saves adapters alone, where it has moved."""


@PreTrainedConfig.register_subclass(POLICY_TYPE)
@dataclass
class RoboRecoverInterventionConfig(NotTrained, PreTrainedConfig):
    """A base policy, and what may step in for it (paper, "Benchmark-Guided Recovery Interventions")."""

    base: MemberConfig = field(default_factory=MemberConfig)
    """The policy that acts, unless an intervention does."""
    correction: MemberConfig = field(default_factory=MemberConfig)
    """The policy that acts for `correction_steps`, in modes that end in `correction`."""
    monitor: MonitorConfig = field(default_factory=MonitorConfig)
    """Who decides when, in modes that start with `monitor`; with `human` as well, where one is given."""
    mode: str = "direct"
    """`direct`, `reversion`, `correction`, `monitor_reversion`, `monitor_correction` or `human`."""
    correction_steps: int = 30
    """Steps of the correction policy before the base goes on."""
    rewind_steps: int | None = None
    """Steps that a rollback goes back, never beyond the task's start. Default: the paper's, 30, and on
    RoboTwin 60 for tasks with a horizon of 500 or more."""
    controller: str = ""
    """Of mode `human`: `package.module:function`, which returns a
    `policies.interventions.takeover.TakeoverController`."""
    driver: str | None = None
    """Earlier name of `controller`."""
    push_to_hub: bool = False

    counted_elsewhere: ClassVar[tuple[str, ...]] = (
        "base", "correction", "monitor", "mode", "correction_steps", "rewind_steps", "controller",
        "driver",
    )  # fmt: skip
    """Fields that `policies.metadata.intervention_facts` says by content, in `TrialRow.options`."""

    def __post_init__(self) -> None:
        move_old_fields(self, "--policy.", {"driver": "controller"})
        super().__post_init__()

    def check(self) -> None:
        """Refuses what cannot be used; not while parsing, where draccus would bury the message.

        Raises:
            OptionError: naming the option, its value and what it may be.
        """
        if self.mode not in MODES:
            raise OptionError(f"--policy.mode={self.mode}: not one of {', '.join(MODES)}")
        needed = ["base"]
        needed += ["correction"] if self.mode.endswith("correction") else []
        needed += ["monitor"] if self.mode.startswith("monitor") else []
        for name in needed:
            if not getattr(self, name).path:
                raise OptionError(
                    f"--policy.mode={self.mode} needs --policy.{name}.path, a checkpoint's folder or Hub id"
                )
        if not 1 <= self.correction_steps <= 100_000:
            raise OptionError(
                f"--policy.correction_steps={self.correction_steps}: a step count from 1 to 100000"
            )
        if self.rewind_steps is not None and not 1 <= self.rewind_steps <= 100_000:
            raise OptionError(f"--policy.rewind_steps={self.rewind_steps}: a step count from 1 to 100000")
        if self.mode == "human" and not self.controller:
            raise OptionError(
                "--policy.mode=human needs --policy.controller=package.module:function, which returns the "
                "controller"
            )

    @property
    def monitored(self) -> bool:
        """Whether a monitor decides when to intervene."""
        return self.mode.startswith("monitor") or (self.mode == "human" and bool(self.monitor.path))

    def get_optimizer_preset(self) -> OptimizerConfig:
        """Refuses: its members are trained on their own."""
        raise OptionError(
            "roborecover_intervention is put together, not trained: train its correction policy with "
            "lerobot-train (docs/interventions.md) and name it with --policy.correction.path"
        )

    def validate_features(self) -> None:
        """Members are checked against the environment when they are loaded."""
