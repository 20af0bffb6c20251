"""Renders a scenario dataset's prefixes as episodes: the last stage of a build writes this LeRobotDataset.

An evaluation needs no episodes; they are for viewing and training. The decisions and records of the earlier
stages are copied into the dataset.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.funnel import DECISIONS_FILE, carry_decisions
from lerobot_roborecover.datasets.certificate import CERTIFICATE_FILE
from lerobot_roborecover.datasets.read import read_with_manifest
from lerobot_roborecover.datasets.render import check_rendering, forget_shards, render_dataset
from lerobot_roborecover.datasets.schema import FOLDER, MANIFEST_FILE
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir, check_new
from lerobot_roborecover.utils.options import option
from lerobot_roborecover.utils.text import next_command, pluralize
from lerobot_roborecover.workers.jobs import JobPool

SIZE = 256
"""Side of the pictures in pixels, where the simulator lets one choose: that of `collect`."""


@dataclass(frozen=True)
class RenderRequest:
    """What to render and how."""

    dataset: Path = option(positional=True)
    """Folder of a scenario dataset."""
    out: Path = option()
    """Folder of the new dataset; new or empty."""
    size: int = option(SIZE, name="frames", metavar="SIZE")
    """Side of the pictures, pixels.

    RoboTwin's own configuration says how large they are.
    """
    env: Sequence[str] = option((), metavar="KEY=VALUE")
    """Option of the recovery env type, e.g. render_quality=fast; may be given again."""
    workers: int = option(1, name="num-workers", old=("workers",))
    """Processes that replay and render."""
    work: Path | None = option(None, metavar="DIR")
    """Finished parts, kept between runs (OUT.parts)."""


def render(request: RenderRequest, progress: Callable[[int, int], None] = lambda done, total: None) -> int:
    """Renders and writes; a rerun goes on where it was stopped.

    Args:
        request: what and how.
        progress: called with how many parts are done of how many.

    Returns:
        The number of episodes.

    Raises:
        ScenarioError, OptionError, SimulatorError: something cannot be used, or the machine cannot render.
    """
    check_new(request.out)
    check_size(request.size)
    if request.workers < 1:
        raise OptionError(f"--num-workers={request.workers}: at least 1")
    scenarios, manifest = read_with_manifest(request.dataset)
    empty = [s.id for s in scenarios if not len(s.prefix)]
    if empty:
        raise ScenarioError(f"scenario {empty[0]} has an empty prefix, of which there is nothing to render")
    options = simulator_options(manifest["platform"], request.size, request.env)
    work = request.work or request.out.with_name(f"{request.out.name}.parts")
    with (
        JobPool(manifest["platform"], options, request.workers) as pool,
        atomic_dir(request.out) as folder,
    ):
        check_rendering(scenarios, pool)
        render_dataset(
            folder,
            scenarios,
            work,
            pool=pool,
            description=manifest.get("description", ""),
            license=manifest.get("license"),
            progress=progress,
        )
        carry_decisions(request.dataset, folder)
        for path in sorted((request.dataset / FOLDER).glob("*.json")):
            if path.name not in (MANIFEST_FILE, DECISIONS_FILE, CERTIFICATE_FILE):
                shutil.copyfile(path, folder / FOLDER / path.name)
    forget_shards(work)
    return len(scenarios)


def describe(request: RenderRequest, episodes: int) -> str:
    """Returns the result of rendering as text, and the command that follows.

    Args:
        request: what was asked for.
        episodes: number of them.
    """
    done = f"{pluralize(episodes, 'episode')} in {request.out}"
    return f"{done}\n{next_command(publish_next(request.out))}"


def publish_next(root: Path) -> list[str]:
    """Arguments of the `dataset publish` that follows, which is to be completed."""
    return ["dataset", "publish", str(root), "--repo-id", "ORG/NAME"]


def check_size(size: int) -> None:
    """Checks the side of the pictures.

    Raises:
        OptionError: a video cannot have it.
    """
    if not 16 <= size <= 2048 or size % 2:
        raise OptionError(f"frames {size}: an even side of 16 to 2048 pixels, e.g. {SIZE}")


def simulator_options(platform: str, size: int, env: Sequence[str]) -> dict[str, Any]:
    """Options of the simulator that renders, as a recovery env of these options would have them.

    Raises:
        OptionError: there is no such option.
    """
    from lerobot_roborecover.curation.policy_trials import env_config

    given = [f"--{o.removeprefix('--')}" for o in env]
    spec = env_config(platform, "none", given).run_spec()
    named = {o.removeprefix("--").partition("=")[0] for o in given} - {"obs_type"}
    wanted = platform_named(platform).picture_options(size)
    return {**spec.slot.options, **{name: value for name, value in wanted.items() if name not in named}}
