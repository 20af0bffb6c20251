"""Writes state hashes into a scenario dataset that has none, whatever stage it is at.

Sets that were validated before `validate` wrote the replayed state's hash lack it, and so do scenarios from
elsewhere: their handoffs can be told to be within 2 mm, but not to be identical. Every prefix is replayed
twice, the second time by other processes and in the opposite order.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lerobot_roborecover.datasets.contents import list_files
from lerobot_roborecover.datasets.fingerprint import Replayed, fingerprint_scenarios
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.read import read_with_manifest
from lerobot_roborecover.datasets.write import write_scenarios
from lerobot_roborecover.scenario import HANDOFF_TOLERANCE_M, Fingerprint, Scenario, ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir
from lerobot_roborecover.utils.temporary import TemporaryFolder
from lerobot_roborecover.workers.backend import LOCAL, Backend

_SHOWN = 3


@dataclass(frozen=True)
class StatesReport:
    """Summary of the written states."""

    scenarios: int
    filled: int
    """Scenarios that had no hash; the others had this one already."""
    largest_mm: float
    """Largest displacement of a body from where it was recorded."""


def write_states(
    root: Path,
    out: Path,
    workers: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
    workplace: Backend = LOCAL,
) -> StatesReport:
    """Writes a copy of a dataset whose scenarios all have the hash of their state at the recovery point.

    Nothing else of a scenario changes: not its reset, prefix, split, labels, provenance and recorded poses,
    and so not its own hash.

    Args:
        root: the dataset's folder.
        out: folder of the copy, new or empty.
        workers: processes that replay; 0 takes one, or all CPUs of a cluster.
        progress: called with the numbers of replays done and in all.
        workplace: where they are.

    Raises:
        ScenarioError: a scenario cannot be replayed, two replays of it differ, it is elsewhere than it was
            recorded, or it has another hash; nothing is written then.
        SimulatorError: the simulator cannot be made, or a worker process died.
    """
    workplace.check()
    scenarios, manifest = read_with_manifest(root)
    with TemporaryFolder("states") as work:

        def replay(order: Sequence[Scenario], turn: int) -> list[Replayed]:
            return fingerprint_scenarios(
                order, work / f"{turn}.jsonl", options={"obs_type": "state"}, workers=workers,
                workplace=workplace,
                progress=lambda done, total: progress(turn * total + done, 2 * total),
            )  # fmt: skip

        first, second = replay(scenarios, 0), replay(scenarios[::-1], 1)[::-1]
    marked, problems, distances = [], [], [0.0]
    for scenario, one, other in zip(scenarios, first, second, strict=True):
        problem, distance_mm = _compared(scenario, one, other)
        distances.append(distance_mm)
        if problem:
            problems.append(f"scenario {scenario.id}: {problem}")
        elif (mark := one.scenario.fingerprint) is not None:
            marked.append(replace(scenario, fingerprint=_marked(scenario.fingerprint, mark)))
    if problems:
        raise ScenarioError(
            f"{root}: {len(problems)} of {len(scenarios)} scenarios get no hash, so nothing is written. "
            + "; ".join(problems[:_SHOWN])
        )
    frames = FrameStore(root)
    with atomic_dir(out) as folder:
        for name in list_files(root):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(root / name, folder / name)
        write_scenarios(
            folder,
            marked,
            description=manifest.get("description", ""),
            license=manifest.get("license"),
            frames=(frames.of(s) for s in marked if s.id in frames),
        )
    filled = sum(not (s.fingerprint and s.fingerprint.state_sha256) for s in scenarios)
    return StatesReport(len(scenarios), filled, max(distances))


def _marked(recorded: Fingerprint | None, replayed: Fingerprint) -> Fingerprint:
    if recorded is None:
        return replayed
    return replace(recorded, state_sha256=replayed.state_sha256, versions=replayed.versions)


def _compared(scenario: Scenario, one: Replayed, other: Replayed) -> tuple[str, float]:
    """What speaks against a scenario's replayed state, and how far it is from the recorded one, in mm."""
    mark, again = one.scenario.fingerprint, other.scenario.fingerprint
    if one.error or other.error or mark is None or again is None:
        return f"it cannot be replayed ({one.error or other.error})", 0.0
    if not mark.state_sha256:
        return "its simulator gives no hash of its state", 0.0
    if mark.state_sha256 != again.state_sha256:
        return "two replays reach different states", 0.0
    recorded = scenario.fingerprint
    if recorded is None:
        return "", 0.0
    if recorded.state_sha256 not in ("", mark.state_sha256):
        return "the state is not the recorded one; compare versions (roborecover doctor)", 0.0
    missing = sorted(set(recorded.bodies) - set(mark.bodies))
    if missing:
        return f"the simulator has no body {missing[0]!r}, which was recorded", 0.0
    far = max(recorded.bodies, key=lambda n: mark.bodies[n].distance_m(recorded.bodies[n]))
    distance_m = mark.bodies[far].distance_m(recorded.bodies[far])
    if not distance_m <= HANDOFF_TOLERANCE_M:
        return (
            f"{far} is {distance_m * 1e3:.2f} mm from where it was recorded; the limit is "
            f"{HANDOFF_TOLERANCE_M * 1e3:g} mm"
        ), distance_m * 1e3
    return "", distance_m * 1e3
