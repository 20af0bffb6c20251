"""What a collection is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.curation.collect.exclusions import check_rules
from lerobot_roborecover.curation.collect.experts import check_expert
from lerobot_roborecover.curation.collect.judge import FilterConfig
from lerobot_roborecover.curation.rollout import PERTURBED_STEPS
from lerobot_roborecover.datasets.licenses import license_argument
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.starts import RELEASE_SEED, Starts
from lerobot_roborecover.utils.options import internal, json_object, option
from lerobot_roborecover.workers.backend import LOCAL, Backend


def parse_side(text: str) -> int:
    """Side of the pictures in pixels, as it is written; 0 for `none`.

    Raises:
        OptionError: it is neither.
    """
    if text != "none" and not text.isdigit():
        raise OptionError(f"--frames={text}: none, or a side in pixels")
    return 0 if text == "none" else int(text)


@dataclass(frozen=True, kw_only=True)
class CollectOptions:
    """What to collect."""

    platform: str = internal("")
    """Name of a registered platform."""
    policy: str = internal("")
    """Folder or Hub id of a checkpoint; or else:"""
    expert: str = option("", metavar="NAME")
    """A scripted controller instead of a policy; ? lists them."""
    name: str = ""
    """Recorded name of the controller (checkpoint, or expert)."""
    out: Path = option(metavar="DIR", asked=False)
    """Folder of the candidate dataset; needed to collect."""
    work: Path | None = option(None, metavar="DIR")
    """Folder of the rollouts, kept (OUT.work).

    Another collection from the same rollouts shares it.
    """
    tasks: tuple[str, ...] = option((), name="task", metavar="PATTERN")
    """Suite, task, or suite/task, with * and ?; repeat it for several."""
    starts: Starts
    """Which initial states."""
    seed: int = RELEASE_SEED
    """Seed of the perturbation, of the policy's noise, and of controllers that draw."""
    horizon: int = option(0, metavar="STEPS")
    """Budget of each task, of the rollouts and of what is built from them (the platform's)."""
    perturb: bool = False
    """Add Uniform(-1, 1) to the translations of early actions."""
    perturb_steps: int = option(PERTURBED_STEPS, metavar="N")
    """How many steps."""
    judging: FilterConfig = field(default_factory=FilterConfig)
    """What is kept."""
    frames: int = option(256, text="256", metavar="none|SIZE", parse=parse_side)
    """Side of the pictures, pixels.

    0 renders none.
    """
    frame_stride: int = option(1, metavar="N", old=("film-every",))
    """Render every Nth step alone, where that is slow; it stands until the next."""
    num_workers: int = option(0, old=("slots",))
    """Simulators at once (one per core, or CPU of a cluster).

    On a cluster all CPUs that policies leave over.
    """
    workplace: Backend = LOCAL
    """Where rollouts are, and replays for the pictures."""
    replicas: int = option(0, metavar="N")
    """Copies of a policy on the cluster (one per GPU, or one on the CPU)."""
    max_batch: int = 1
    """Slots that a policy is asked for at once.

    With 1 the result does not depend on their number.
    """
    device: str | None = None
    """Device of the policy."""
    env: tuple[str, ...] = internal(())
    """`name=value` of the recovery env type: what the policy sees."""
    policy_options: tuple[str, ...] = internal(())
    """`name=value` of the policy's config."""
    rename_map: Mapping[str, str] = option(
        factory=dict, name="rename_map", parse=json_object("--rename_map", "observation keys")
    )
    """The env's observation keys to the policy's, JSON."""
    part_size: int = 20
    """Candidates written at a time."""
    watchdog_s: float = option(600.0, name="watchdog", metavar="S")
    """Longest a simulator may be silent."""
    retry_errors: bool = False
    """Roll out again what broke in an earlier run."""
    description: str = ""
    """Description of the dataset."""
    license: str | None = option(None, parse=license_argument)
    """Licence by the Hub's identifier, of the dataset; none is assumed."""

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
            ("perturb_steps", 1, 100_000), ("seed", 0, 2**32 - 1), ("num_workers", 0, 4096),
            ("replicas", 0, 4096), ("horizon", 0, 10_000), ("max_batch", 1, 4096), ("part_size", 1, 10_000),
            ("watchdog_s", 1, 86_400),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                shown = name.removesuffix("_s").replace("_", "-")
                raise OptionError(f"--{shown}={getattr(self, name)}: must be from {low} to {high}")
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
