"""What differs between the versions of LeRobot that this package runs with.

`pyproject.toml` asks for the oldest one and newer. Physics, which decides scores, lies in pinned packages;
LeRobot's version is written to every row. Reads metadata only, but for the functions that ask LeRobot itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from importlib import metadata

from packaging.version import Version

OLDEST = "0.6.1"
"""The oldest LeRobot that this package runs with, and the one that its tests run with (`constraints.txt`)."""
TESTED = (OLDEST, "0.6.2 (main, 23 August 2026)")
"""What tests were run with; docs/install.md says which tests."""


def version_problem(found: str | None) -> str | None:
    """What is wrong with an installed LeRobot, with the remedy; None from the oldest one on.

    Args:
        found: its version; None where it is not installed.
    """
    remedy = f"pip install 'lerobot>={OLDEST}'"
    if found is None:
        return f"LeRobot is not installed as a package: {remedy}"
    if Version(found) >= Version(OLDEST):
        return None
    return f"lerobot is {found}; RoboRecover runs with {OLDEST} or newer: {remedy}"


def installed_problem() -> str | None:
    """`version_problem` of the LeRobot that is installed here."""
    try:
        return version_problem(metadata.version("lerobot"))
    except metadata.PackageNotFoundError:
        return version_problem(None)


@dataclass(frozen=True)
class Replaced:
    """What this package has because the oldest LeRobot lacks it: to be removed once `OLDEST` has it."""

    ours: str
    """Module or option of this package."""
    lerobots: str
    """What LeRobot has in its place."""
    there: Callable[[], bool]
    """Whether the installed LeRobot has it; imports LeRobot."""


def takes_strategies() -> bool:
    """Returns whether `lerobot-rollout` runs strategies of other packages (huggingface/lerobot#4559)."""
    from lerobot.rollout.configs import RolloutStrategyConfig

    return hasattr(RolloutStrategyConfig, "requires_teleop")


def averages_weights() -> bool:
    """Returns whether `lerobot-train` averages weights itself (huggingface/lerobot#4323)."""
    return "ema" in _training_fields()


def accumulates_gradients() -> bool:
    """Returns whether `lerobot-train` accumulates gradients itself."""
    return "accelerator" in _training_fields()


def publishes_reward_models() -> bool:
    """Returns whether `lerobot-train` publishes a reward model without the model's own method."""
    from lerobot.common import train_utils

    return hasattr(train_utils, "publish_trained_model")


REPLACED = (
    Replaced("policies/ema.py, policies/export_ema.py, cli/export_ema.py", "--ema.enable", averages_weights),
    Replaced(
        "micro_batch_size of roborecover_monitor", "--accelerator.gradient_accumulation.steps",
        accumulates_gradients,
    ),
    Replaced(
        "push_model_to_hub of policies/detectors/monitor/base.py", "publish_trained_model",
        publishes_reward_models,
    ),
)  # fmt: skip


def _training_fields() -> set[str]:
    from lerobot.configs.train import TrainPipelineConfig

    return {field.name for field in fields(TrainPipelineConfig)}
