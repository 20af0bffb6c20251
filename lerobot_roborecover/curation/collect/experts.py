"""The scripted controllers of a platform, for `roborecover curate collect --expert`."""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_roborecover.platforms import all_platforms, platform_named
from lerobot_roborecover.platforms.base import Controller
from lerobot_roborecover.scenario import ScenarioError, Task
from lerobot_roborecover.utils.text import align


def make_controller(name: str, simulator: Any, task: Task, rng: np.random.Generator) -> Controller:
    """A controller for a simulator that has been reset and has settled.

    Args:
        name: of the platform's experts.
        simulator: of the task's platform.
        task: what to drive.
        rng: of controllers that draw.
    """
    return platform_named(task.platform).experts[name].make(simulator, task, rng)


def check_expert(platform: str, name: str) -> None:
    """Refuses a name that there is not.

    Raises:
        ScenarioError: naming those that there are.
    """
    known = platform_named(platform).experts
    if name in known:
        return
    if not known:
        raise ScenarioError(
            f"--expert {name}: {platform} has no scripted controller here; use --policy.path=CHECKPOINT"
        )
    there = "; ".join(f"{n} ({expert.about})" for n, expert in known.items())
    raise ScenarioError(f"--expert {name!r:.80}: {platform} has {there}")


def list_experts(platform: str = "") -> str:
    """The scripted controllers of a platform, or of every one, a line each."""
    rows = [
        (found.name, name, expert.about)
        for found in all_platforms()
        for name, expert in found.experts.items()
        if platform in ("", found.name)
    ]
    return (
        "\n".join(align(rows, left=(0, 1, 2)))
        or f"{platform} has no scripted controller here; use --policy.path=CHECKPOINT"
    )
