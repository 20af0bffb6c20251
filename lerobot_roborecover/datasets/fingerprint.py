"""Replays many scenarios in parallel to give each its exact reset and handoff fingerprint; resumable.

Every finished scenario is one line of a log, so that a stopped run goes on where it was. Workers import
neither LeRobot nor torch.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_roborecover.datasets.replay_log import ReplayItem, deciding_versions, replay_logged
from lerobot_roborecover.platforms import SimulatorError
from lerobot_roborecover.platforms.simulator import Simulator
from lerobot_roborecover.replay.handoff import record_handoff
from lerobot_roborecover.scenario import Fingerprint, Pose, Scenario, ScenarioError
from lerobot_roborecover.workers.backend import LOCAL, Backend
from lerobot_roborecover.workers.jobs import JobPool, simulator_of_worker

type ResetCheck = Callable[[Simulator, Scenario], dict[str, float]]
"""Measures how far the simulator, just reset, is from what a scenario's record says; raises `ScenarioError`
beyond what may be."""

_SCENARIOS_PER_JOB = 8
"""A simulator is kept from job to job."""


@dataclass(frozen=True)
class Replayed:
    """What became of one scenario."""

    scenario: Scenario
    """With its exact reset and fingerprint, unless there is an error."""
    deviations: Mapping[str, float]
    """What the reset check measured."""
    error: str = ""
    """Why it could not be replayed."""


def fingerprint_scenarios(
    scenarios: Sequence[Scenario],
    log: Path,
    *,
    options: Mapping[str, Any] | None = None,
    check: ResetCheck | None = None,
    workers: int = 1,
    pool: JobPool | None = None,
    workplace: Backend = LOCAL,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Replayed]:
    """Replays every scenario once.

    Args:
        scenarios: of one platform.
        log: JSON lines, one a replayed scenario; what it holds already is not done again. Scenarios that
            failed are tried again.
        options: of the simulator, JSON values.
        check: a function of a module, run after each reset.
        workers: processes; see `JobPool`.
        workplace: where they are.
        pool: processes that are there already, with their own options, in place of new ones.
        progress: called with the numbers done and in all.

    Returns:
        One result a scenario, in order.

    Raises:
        SimulatorError: the simulator cannot be made, or a worker process died.
    """
    if not scenarios:
        return []
    platform = scenarios[0].platform
    options = dict(options or {}) if pool is None else pool.options
    versions = deciding_versions(platform, options)
    items = [
        ReplayItem(s, hashlib.sha256(f"{s.sha256()} {versions}".encode()).hexdigest()) for s in scenarios
    ]
    used = nullcontext(pool) if pool else JobPool(platform, options, workers, workplace=workplace)
    with used as processes:
        entries = replay_logged(
            items, log, processes, _replay, lambda part: (part, check),
            per_job=_SCENARIOS_PER_JOB, progress=progress,
        )  # fmt: skip
    return [_apply(item.scenario, entry) for item, entry in zip(items, entries, strict=True)]


def _replay(scenarios: Sequence[Scenario], check: ResetCheck | None) -> list[dict[str, Any]]:
    simulator = simulator_of_worker()
    entries = []
    for scenario in scenarios:
        try:
            simulator.reset(scenario.task, scenario.reset)
            deviations = check(simulator, scenario) if check else {}
            reset, mark = record_handoff(simulator, scenario)
        except (ScenarioError, SimulatorError) as err:
            entries.append({"id": scenario.id, "error": str(err)})
            continue
        except Exception as err:  # simulators raise types of their own; one record must not stop the others
            entries.append({"id": scenario.id, "error": f"{type(err).__name__}: {err}"})
            continue
        entries.append(
            {
                "id": scenario.id,
                "deviations": deviations,
                "fixtures": pose_lists(reset.fixtures),
                "step": mark.step,
                "bodies": pose_lists(mark.bodies),
                "state_sha256": mark.state_sha256,
                "versions": dict(mark.versions),
            }
        )
    return entries


def _apply(scenario: Scenario, entry: Mapping[str, Any]) -> Replayed:
    if "error" in entry:
        return Replayed(scenario, {}, entry["error"])
    mark = Fingerprint(entry["step"], poses_of(entry["bodies"]), entry["state_sha256"], entry["versions"])
    reset = replace(scenario.reset, fixtures=poses_of(entry["fixtures"]))
    return Replayed(replace(scenario, reset=reset, fingerprint=mark), entry["deviations"])


def pose_lists(poses: Mapping[str, Pose]) -> dict[str, list[float]]:
    """Poses as JSON values: position, metres, and quat_xyzw."""
    return {name: [*p.position_m, *p.quat_xyzw] for name, p in poses.items()}


def poses_of(lists: Mapping[str, Sequence[float]]) -> dict[str, Pose]:
    """The poses of `pose_lists`."""
    return {name: Pose.of(p) for name, p in lists.items()}
