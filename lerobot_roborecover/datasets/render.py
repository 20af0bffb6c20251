"""Renders the prefixes of many scenarios as one LeRobotDataset, or their last frames alone, in parallel and
resumable.

Each worker writes a shard of a few episodes as a dataset of its own; LeRobot's own merge joins the shards
without encoding anything again. Rendering is what takes the time: on LIBERO 160 ms of CPU a step for two
pictures of 256 pixels, ten times the physics. The last frames alone are five steps of it, and need no
LeRobot.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from lerobot_roborecover.datasets.episodes import render_prefix
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import LastFrames, last_frames
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.datasets.write import write_scenarios
from lerobot_roborecover.platforms import SimulatorError
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir, check_new
from lerobot_roborecover.workers.jobs import JobPool, simulator_of_worker

_EPISODES_PER_SHARD = 10
_TRIED = 3
"""Scenarios that may fail for reasons of their own before rendering is held to be impossible."""


def render_dataset(
    root: Path,
    scenarios: Sequence[Scenario],
    work: Path,
    *,
    pool: JobPool,
    episodes: bool = True,
    description: str = "",
    license: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Writes scenarios with their last frames, and with their episodes.

    Args:
        root: the dataset's folder; must be new or empty.
        scenarios: of one platform, each with a prefix of at least one action.
        work: folder of finished shards; a rerun with the same scenarios and options goes on from there.
        pool: processes, each of about 2 GB; their simulators' observation options decide the features.
        episodes: write the prefixes' observations as well, not the last frames alone.
        description: free text for the manifest.
        license: SPDX identifier, or None where none is decided.
        progress: called with the numbers of shards done and in all.

    Raises:
        ScenarioError: the folder is not empty, or the set is invalid.
        SimulatorError: a scenario cannot be replayed, or a worker process died.
    """
    check_new(root)
    shards = []
    for begin in range(0, len(scenarios), _EPISODES_PER_SHARD):
        part = scenarios[begin : begin + _EPISODES_PER_SHARD]
        said = f"{begin} {[s.sha256() for s in part]} {sorted(pool.options.items())} {episodes}"
        name = hashlib.sha256(said.encode()).hexdigest()[:16]
        shards.append((begin, part, work / f"shard-{begin:06d}-{name}", episodes))
    todo = [shard for shard in shards if not shard[2].is_dir()]
    done = len(shards) - len(todo)
    progress(done, len(shards))
    work.mkdir(parents=True, exist_ok=True)
    # Each shard keeps its last frames as a file of its own, so that they never have to fit into memory.
    for _ in pool.run(_render_shard, todo, lambda shard: shard):
        done += 1
        progress(done, len(shards))
    paths = [path for _, _, path, _ in shards]
    with atomic_dir(root) as folder:
        if episodes:
            # In a process that has LeRobot already.
            pool.call(_join, paths, [len(s.prefix) for s in scenarios], folder)
        frames = (found for path in paths for found in FrameStore(path).values())
        write_scenarios(folder, scenarios, description=description, license=license, frames=frames)
    return root


def forget_shards(work: Path) -> None:
    """Removes the finished shards of `render_dataset`, and their folder where it holds nothing else."""
    for shard in work.glob("shard-*"):
        shutil.rmtree(shard, ignore_errors=True)
    with suppress(OSError):
        work.rmdir()


def check_rendering(scenarios: Sequence[Scenario], pool: JobPool) -> None:
    """Looks at a reset in one of the processes, so that a machine that cannot render says so before hours of
    replay.

    Args:
        scenarios: of one platform; the first few are tried until one can be looked at.
        pool: the processes.

    Raises:
        SimulatorError: none of them can be looked at; says why.
    """
    pool.call(_look, list(scenarios[:_TRIED]))


def _look(scenarios: Sequence[Scenario]) -> None:
    simulator = simulator_of_worker()
    for number, scenario in enumerate(scenarios, 1):
        try:
            simulator.reset(scenario.task, scenario.reset)
            simulator.observe()
            return
        except (ScenarioError, SimulatorError):
            if number == len(scenarios):
                raise


def _render_shard(begin: int, scenarios: Sequence[Scenario], path: Path, episodes: bool) -> None:
    simulator = simulator_of_worker()
    last: list[LastFrames] = []
    with atomic_dir(path) as folder:
        if episodes:
            from lerobot_roborecover.datasets.encoding import write_lerobot_dataset

            drawn = (render_prefix(simulator, scenario, last) for scenario in scenarios)
            write_lerobot_dataset(folder, scenarios, drawn, round(simulator.control_hz), first_index=begin)
        else:
            last.extend(last_frames(simulator, scenario) for scenario in scenarios)
        write_scenarios(folder, scenarios, frames=last)


def _join(paths: Sequence[Path], steps: Sequence[int], folder: Path) -> None:
    """Joins the episodes of shards as one dataset; a single one, whose frames are counted, is copied."""
    if len(paths) == 1:
        shutil.copytree(paths[0], folder, ignore=shutil.ignore_patterns(Path(FOLDER).name))
        return
    from lerobot_roborecover.datasets.encoding import join_datasets

    join_datasets(folder, paths, steps)
