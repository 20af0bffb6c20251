"""What the scripts of `conversion/` that make trajectory datasets have in common."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from lerobot_roborecover.datasets.trajectories import TrajectoryRow, read_trajectories
from lerobot_roborecover.datasets.trajectory_write import Trajectory, write_trajectories
from lerobot_roborecover.platforms import SimulatorError
from lerobot_roborecover.scenario import ScenarioError


def write_converted(
    program: str,
    out: Path,
    convert: Callable[[list[str]], Iterator[Trajectory]],
    *,
    fps: int,
    description: str,
    license: str | None,
) -> int:
    """Writes converted rollouts and says what became of them.

    Args:
        program: the script's name, for messages.
        out: new folder of the dataset.
        convert: yields the trajectories; adds to its argument what is wrong with an episode that it leaves
            out.
        fps: frame rate.
        description: free text for the manifest.
        license: SPDX identifier, or None where none is decided.

    Returns:
        Exit status: 0 done, 1 done but some episodes were refused, 2 nothing was written.
    """
    failed: list[str] = []
    try:
        write_trajectories(
            out, "rollouts", convert(failed), fps=fps, description=description, license=license
        )
    except (ScenarioError, SimulatorError) as err:
        print("\n".join([*failed, f"{program}: {err}"]), file=sys.stderr)
        return 2
    for line in failed:
        print(line, file=sys.stderr)
    say(out, read_trajectories(out).rows, len(failed))
    return int(bool(failed))


def each_source(
    sources: Sequence[Path], episodes: Callable[[Path], Iterator[Trajectory]], failed: list[str]
) -> Iterator[Trajectory]:
    """Yields the trajectories of files or folders; one that cannot be read does not stop the others.

    Args:
        sources: files or folders.
        episodes: yields the trajectories of one.
        failed: takes what is wrong with a source that is left out.
    """
    for source in sources:
        try:
            yield from episodes(source)
        except (ScenarioError, SimulatorError) as err:
            failed.append(str(err) if str(source) in str(err) else f"{source}: {err}")


def say(out: Path, rows: Sequence[TrajectoryRow], refused: int = 0) -> None:
    """Prints what was written, and every reason against an exact replay."""
    exact = sum(not row.not_replayable for row in rows)
    print(
        f"{out}: {len(rows)} trajectories, {sum(row.success for row in rows)} successful, {exact} replayable "
        f"exactly; {refused} refused"
    )
    for reason, count in sorted(Counter(row.not_replayable for row in rows if row.not_replayable).items()):
        print(f"  {count}: {reason}")
