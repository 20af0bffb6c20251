"""Renders the prefixes of many scenarios as one LeRobotDataset, in parallel and resumable.

Each worker writes a shard of a few episodes as a dataset of its own; LeRobot's own merge joins the shards
without encoding anything again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_roborecover.datasets.episodes import render_prefix, write_lerobot_dataset
from lerobot_roborecover.datasets.fingerprint import run_jobs, simulator_of_worker
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import LastFrames
from lerobot_roborecover.datasets.write import write_scenarios
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.simulators import SimulatorError
from lerobot_roborecover.whole import check_new, new_folder

_EPISODES_PER_SHARD = 10
_TRIED = 3
"""Scenarios that may fail for reasons of their own before rendering is held to be impossible."""


def render_dataset(
    root: Path,
    scenarios: Sequence[Scenario],
    work: Path,
    *,
    options: Mapping[str, Any] | None = None,
    workers: int = 1,
    description: str = "",
    license: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Writes scenarios with their episodes.

    Args:
        root: the dataset's folder; must be new or empty.
        scenarios: of one platform, each with a prefix of at least one action.
        work: folder of finished shards; a rerun with the same scenarios and options goes on from there.
        options: of the simulator, JSON values; its observation options decide the features.
        workers: processes; each takes about 2 GB.
        description: free text for the manifest.
        license: SPDX identifier, or None where none is decided.
        progress: called with the numbers of shards done and in all.

    Raises:
        ScenarioError: the folder is not empty, or the set is invalid.
        SimulatorError: a scenario cannot be replayed, or a worker process died.
    """
    from lerobot.datasets.aggregate import aggregate_datasets

    check_new(root)
    options = dict(options or {})
    shards = []
    for begin in range(0, len(scenarios), _EPISODES_PER_SHARD):
        part = scenarios[begin : begin + _EPISODES_PER_SHARD]
        name = hashlib.sha256(f"{begin} {[s.sha256() for s in part]} {sorted(options.items())}".encode())
        shards.append((begin, part, work / f"shard-{begin:06d}-{name.hexdigest()[:16]}"))
    todo = [shard for shard in shards if not shard[2].is_dir()]
    done = len(shards) - len(todo)
    progress(done, len(shards))
    work.mkdir(parents=True, exist_ok=True)
    # Each shard keeps its last frames as a file of its own, so that they never have to fit into memory.
    for _ in run_jobs(_render_shard, todo, todo, scenarios[0].platform, options, workers):
        done += 1
        progress(done, len(shards))
    with new_folder(root) as folder:
        names = [f"roborecover/{path.name}" for *_, path in shards]
        aggregate_datasets(names, f"roborecover/{root.name}", [path for *_, path in shards], folder)
        frames = (found for *_, path in shards for found in FrameStore(path).values())
        write_scenarios(folder, scenarios, description=description, license=license, frames=frames)
    return root


def check_rendering(scenarios: Sequence[Scenario], options: Mapping[str, Any] | None = None) -> None:
    """Looks at a reset in a process of its own, so that a machine that cannot render says so before hours of
    replay.

    Args:
        scenarios: of one platform; the first few are tried until one can be looked at.
        options: of the simulator, JSON values.

    Raises:
        SimulatorError: none of them can be looked at; says why.
    """
    some = list(scenarios[:_TRIED])
    for _ in run_jobs(_look, [(some,)], [0], some[0].platform, dict(options or {}), 1):
        pass


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


def _render_shard(begin: int, scenarios: Sequence[Scenario], path: Path) -> None:
    simulator = simulator_of_worker()
    last: list[LastFrames] = []
    episodes = (render_prefix(simulator, scenario, last) for scenario in scenarios)
    with new_folder(path) as folder:
        write_lerobot_dataset(folder, scenarios, episodes, round(simulator.control_hz), first_index=begin)
        write_scenarios(folder, scenarios, frames=last)
