"""Writes training data: a LeRobotDataset whose frames say how they turned out, and RA-BC's progress file.

Every episode is replayed with pictures as the platform gives them to a policy; one whose replay does not end
as its log says is left out. Beside LeRobot's columns and ours (`datasets.trajectories`), each frame has:

    next.success, next.done            bool: the action solved the task; it is the episode's last
    next.reward                        float32: the step's share of the return (`returns`)
    complementary_info.is_intervention bool: the action was not chosen by the trial's policy
    roborecover.progress               float32: of the task before the action; NaN where it is not known
    roborecover.return_to_go, .value, .advantage   float32 (`returns`)

`sarm_progress.parquet` is what LeRobot's RA-BC reads (`lerobot.rewards.sarm.rabc`): `progress_sparse` is the
task's progress, `progress_dense` 1 + the return to go.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.curation.training.lines import TrainingLine
from lerobot_roborecover.curation.training.returns import returns_to_go, values
from lerobot_roborecover.datasets.rendered_steps import RenderedSteps, RenderJob, replayed
from lerobot_roborecover.datasets.trajectory_write import Trajectory, write_trajectories
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write

PROGRESS_FILE = "sarm_progress.parquet"
"""Name by which LeRobot finds it in the dataset's folder."""
SUCCESS, DONE, REWARD = "next.success", "next.done", "next.reward"
INTERVENTION = "complementary_info.is_intervention"
"""As LeRobot's own recordings of interventions have it (`lerobot.rl.buffer`)."""
PROGRESS, RETURN = "roborecover.progress", "roborecover.return_to_go"
VALUE, ADVANTAGE = "roborecover.value", "roborecover.advantage"


@dataclass(frozen=True)
class Exported:
    """Summary of the exported training data."""

    episodes: int
    frames: int
    interventions: int
    """Frames whose action the trial's policy did not choose."""
    successes: int
    progress_known: bool


def export_training(
    out: Path,
    lines: Sequence[TrainingLine],
    *,
    simulator: Mapping[str, Any],
    workers: int,
    dropped: Counter,
    description: str = "",
    license: str | None = None,
    on_episode: Callable[[int, int], None] = lambda done, total: None,
    also: Callable[[Path], object] = lambda folder: None,
) -> Exported:
    """Replays and writes the episodes; the dataset appears as a whole, or not at all.

    Args:
        out: the dataset's folder; new or empty.
        lines: the episodes, of one platform.
        simulator: its options, which decide the observations.
        workers: processes that replay.
        dropped: called with episodes that do not replay.
        description: free text.
        license: SPDX identifier, or None where none is decided.
        on_episode: called with how many are done of how many.
        also: writes further files into the folder before it appears.

    Raises:
        ScenarioError: there is nothing to write.
    """
    from lerobot_roborecover.datasets.episodes import to_frame
    from lerobot_roborecover.platforms import make_simulator

    if not lines:
        why = "; ".join(f"{n} {reason}" for reason, n in dropped.most_common()) or "the logs are empty"
        raise ScenarioError(f"no episode is left for {out}: {why}")
    platform = lines[0].scenario.platform
    probe = make_simulator(platform, **simulator)
    fps = round(probe.control_hz)
    probe.close()
    told: list[dict[str, np.ndarray]] = []

    def trajectories() -> Iterator[Trajectory]:
        jobs = [RenderJob(line.start, line.actions, line.state_steps) for line in lines]
        replays = zip(lines, values(lines), replayed(jobs, simulator, workers), strict=True)
        for number, (line, value, replay) in enumerate(replays, 1):
            if replay.succeeded != line.success or len(replay.observations) != line.steps:
                dropped["whose replay does not end as logged"] += 1
            else:
                told.append(columns_of(line, value, replay))
                yield Trajectory(
                    task=line.scenario.task,
                    driver=line.driver,
                    actions=line.actions[line.first :].astype(np.float64),
                    frames=(to_frame(platform, o) for o in replay.observations),
                    success=line.success,
                    scenario=line.scenario,
                    first_step=line.replayed + line.first,
                    trial=line.trial,
                    columns=told[-1],
                    provenance=line.provenance,
                )
            on_episode(number, len(lines))

    def finish(folder: Path) -> None:
        atomic_write(folder / PROGRESS_FILE, progress_parquet(told))
        also(folder)

    write_trajectories(
        out, "training", trajectories(), fps=fps, description=description, license=license, also=finish
    )
    return Exported(
        len(told),
        sum(len(t[DONE]) for t in told),
        sum(int(t[INTERVENTION].sum()) for t in told),
        sum(int(t[SUCCESS].any()) for t in told),
        any(np.isfinite(t[PROGRESS]).any() for t in told),
    )


def columns_of(line: TrainingLine, value: np.ndarray, replay: RenderedSteps) -> dict[str, np.ndarray]:
    """Returns the columns of an episode's frames beside observation and action.

    Args:
        line: the episode.
        value: (steps,) V.
        replay: its replay.

    Returns:
        (steps,) each, bool or float32.
    """
    last = np.arange(line.steps) == line.steps - 1
    returns = returns_to_go(line)
    reward = returns - np.append(returns[1:], 0.0)
    numbers = {
        REWARD: reward, PROGRESS: replay.progress, RETURN: returns, VALUE: value, ADVANTAGE: returns - value,
    }  # fmt: skip
    flags = {SUCCESS: last & line.success, DONE: last, INTERVENTION: line.intervention[line.first :]}
    return {**flags, **{name: np.asarray(of, np.float32) for name, of in numbers.items()}}


def progress_parquet(episodes: Sequence[Mapping[str, np.ndarray]]) -> bytes:
    """The file that RA-BC reads.

    Args:
        episodes: columns of each, in the order of the dataset.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    lengths = [len(e[DONE]) for e in episodes]
    total = sum(lengths)
    table = pa.table(
        {
            "index": np.arange(total, dtype=np.int64),
            "episode_index": np.repeat(np.arange(len(episodes)), lengths).astype(np.int64),
            "frame_index": np.concatenate([np.arange(n) for n in lengths]).astype(np.int64),
            "progress_sparse": np.concatenate([e[PROGRESS] for e in episodes]),
            "progress_dense": np.concatenate([1.0 + e[RETURN] for e in episodes]).astype(np.float32),
        }
    )
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()
