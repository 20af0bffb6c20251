"""What a collection is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.curation.collect.exclusions import check_rules
from lerobot_roborecover.curation.collect.experts import check_expert
from lerobot_roborecover.curation.collect.judge import FilterConfig
from lerobot_roborecover.curation.collect.starts import Starts
from lerobot_roborecover.curation.rollout import PERTURBED_STEPS
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.workers.backend import LOCAL, Backend


def parse_side(text: str) -> int:
    """Side of the pictures in pixels, as it is written; 0 for `none`.

    Raises:
        OptionError: it is neither.
    """
    if text != "none" and not text.isdigit():
        raise OptionError(f"--frames={text}: none, or a side in pixels")
    return 0 if text == "none" else int(text)


@dataclass(frozen=True)
class CollectOptions:
    """What to collect."""

    platform: str
    """Name of a registered platform."""
    out: Path
    """Folder of the candidate dataset; new."""
    starts: Starts
    tasks: tuple[str, ...]
    """Patterns; see `choose_tasks`."""
    policy: str = ""
    """Folder or Hub id of a checkpoint; or else:"""
    expert: str = ""
    """Name of a scripted controller."""
    name: str = ""
    """Recorded name of the controller; by default the checkpoint's identity, or the expert's name."""
    work: Path | None = None
    """Working folder; by default beside `out`. Another collection from the same rollouts shares it."""
    env: tuple[str, ...] = ()
    """`name=value` of the recovery env type: what the policy sees."""
    policy_options: tuple[str, ...] = ()
    """`name=value` of the policy's config."""
    rename_map: Mapping[str, str] = field(default_factory=dict)
    device: str | None = None
    perturb: bool = False
    perturbed_steps: int = PERTURBED_STEPS
    judging: FilterConfig = field(default_factory=FilterConfig)
    seed: int = 7
    """Of the perturbation, of the policy's noise, and of controllers that draw."""
    horizon: int = 0
    """Budget of each task in steps, of rollouts and of scenarios made from them; 0: the platform's."""
    frame_stride: int = 1
    """Steps from one picture to the next; the last one stands until then."""
    frames: int = 256
    """Side of the pictures in pixels; 0 renders none."""
    workplace: Backend = LOCAL
    """Where rollouts are, and replays for the pictures."""
    slots: int = 0
    """Simulators at once; 0 takes one a core, or all CPUs of a cluster that policies leave over."""
    replicas: int = 0
    """Copies of the policy on a cluster; 0 takes one per GPU, or one on the CPU."""
    max_batch: int = 1
    """Slots that a policy is asked for at once. With 1 the result does not depend on their number."""
    part_size: int = 20
    watchdog_s: float = 600.0
    retry_errors: bool = False
    """Roll out again what broke in an earlier run."""
    description: str = ""
    license: str | None = None

    def check(self) -> None:
        """Checks what can be checked without a catalogue.

        Raises:
            OptionError, ScenarioError: naming the option, its value and what it may be.
        """
        if bool(self.policy) == bool(self.expert):
            raise OptionError(
                "give either --policy.path=CHECKPOINT or --expert NAME"
                + (", not both" if self.policy else "")
            )
        self.workplace.check()
        if self.expert:
            check_expert(self.platform, self.expert)
        for name, low, high in (
            ("perturbed_steps", 1, 100_000), ("seed", 0, 2**32 - 1), ("slots", 0, 4096),
            ("replicas", 0, 4096),
            ("horizon", 0, 10_000), ("max_batch", 1, 4096), ("part_size", 1, 10_000),
            ("watchdog_s", 1, 86_400),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                option = "num-workers" if name == "slots" else name.removesuffix("_s").replace("_", "-")
                raise OptionError(f"--{option}={getattr(self, name)}: must be from {low} to {high}")
        if not 1 <= self.frame_stride <= 1000:
            raise OptionError(f"--frame-stride={self.frame_stride}: 1 to 1000 steps")
        if self.frames and not 16 <= self.frames <= 2048:
            raise OptionError(f"--frames={self.frames}: none, or a side of 16 to 2048 pixels")
        own = platform_named(self.platform)
        if self.perturb and not own.perturbable:
            raise OptionError(f"--perturb: {own.why_not_perturbable}. Collect without it")
        if self.judging.min_displacement_mm and not self.perturb:
            raise OptionError("--min-displacement needs --perturb: it measures what the disturbance moved")
        if self.judging.min_displacement_mm < 0:
            raise OptionError(
                f"--min-displacement={self.judging.min_displacement_mm:g}: millimetres, above 0"
            )
        check_rules("--no-exclude", self.judging.skip)
        check_rules("--exclude-only", self.judging.only)
