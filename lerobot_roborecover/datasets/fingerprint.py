"""Replays many scenarios in parallel to give each its exact reset and handoff fingerprint; resumable.

Every finished scenario is one line of a log, so that a stopped run goes on where it was. Workers import
neither LeRobot nor torch.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_roborecover.platforms import SimulatorError, platform_named
from lerobot_roborecover.platforms.simulator import Simulator
from lerobot_roborecover.platforms.versions import installed
from lerobot_roborecover.replay.handoff import record_handoff
from lerobot_roborecover.scenario import Fingerprint, Pose, Scenario, ScenarioError
from lerobot_roborecover.utils.journal import AppendOnly, InUseError
from lerobot_roborecover.workers.backend import LOCAL, Backend
from lerobot_roborecover.workers.jobs import JobPool, simulator_of_worker

type ResetCheck = Callable[[Simulator, Scenario], dict[str, float]]
"""Measures how far the simulator, just reset, is from what a scenario's record says; raises `ScenarioError`
beyond what may be."""

_SCENARIOS_PER_JOB = 8


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
    versions = _versions(platform, options)
    keys = [hashlib.sha256(f"{s.sha256()} {versions}".encode()).hexdigest() for s in scenarios]
    file, done = _open_log(log)
    open_rows = [i for i, key in enumerate(keys) if key not in done]
    found: dict[int, Replayed] = {}
    for i, key in enumerate(keys):
        if key in done:
            found[i] = _apply(scenarios[i], done[key])
    progress(len(found), len(scenarios))
    jobs = _jobs(scenarios, open_rows)
    used = nullcontext(pool) if pool else JobPool(platform, options, workers, workplace=workplace)
    with file, used as processes:

        def keep(i: int, entry: dict[str, Any]) -> None:
            found[i] = _apply(scenarios[i], entry)
            if not found[i].error:
                file.append(json.dumps({"key": keys[i], **entry}).encode())
            progress(len(found), len(scenarios))

        for rows, entries in processes.run(_replay, jobs, lambda rows: ([scenarios[i] for i in rows], check)):
            for i, entry in zip(rows, entries, strict=True):
                keep(i, entry)
    return [found[i] for i in range(len(scenarios))]


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
                "fixtures": _pose_lists(reset.fixtures),
                "step": mark.step,
                "bodies": _pose_lists(mark.bodies),
                "state_sha256": mark.state_sha256,
                "versions": dict(mark.versions),
            }
        )
    return entries


def _apply(scenario: Scenario, entry: Mapping[str, Any]) -> Replayed:
    if "error" in entry:
        return Replayed(scenario, {}, entry["error"])
    mark = Fingerprint(entry["step"], _poses(entry["bodies"]), entry["state_sha256"], entry["versions"])
    reset = replace(scenario.reset, fixtures=_poses(entry["fixtures"]))
    return Replayed(replace(scenario, reset=reset, fingerprint=mark), entry["deviations"])


def _pose_lists(poses: Mapping[str, Pose]) -> dict[str, list[float]]:
    return {name: [*p.position_m, *p.quat_xyzw] for name, p in poses.items()}


def _poses(lists: Mapping[str, Sequence[float]]) -> dict[str, Pose]:
    return {name: Pose.of(p) for name, p in lists.items()}


def _jobs(scenarios: Sequence[Scenario], rows: Sequence[int]) -> list[list[int]]:
    """Rows in small groups of one task each, because a simulator compiles each task once."""
    by_task: dict[tuple[str, str], list[int]] = {}
    for i in rows:
        by_task.setdefault((scenarios[i].task.suite, scenarios[i].task.name), []).append(i)
    return [
        group[i : i + _SCENARIOS_PER_JOB]
        for group in by_task.values()
        for i in range(0, len(group), _SCENARIOS_PER_JOB)
    ]


def _versions(platform: str, options: Mapping[str, Any]) -> str:
    found = platform_named(platform)
    versions = {name: installed(name) for name in found.required_versions}
    return json.dumps([versions, found.environment_fingerprint(options)])


def _open_log(log: Path) -> tuple[AppendOnly, dict[str, dict[str, Any]]]:
    """The log, and finished scenarios by key; a last line that a crash cut short goes.

    Raises:
        ScenarioError: it is damaged, cannot be written, or another process has it open.
    """
    try:
        file = AppendOnly(log)
    except OSError as err:
        raise ScenarioError(f"{log} cannot be written: {err}. Name another working folder") from err
    except InUseError as err:
        raise ScenarioError(f"{err}; stop that one first, or name another working folder") from None
    found = {}
    for number, line in enumerate(file.lines(), 1):
        try:
            entry = json.loads(line)
            found[entry["key"]] = entry
        except (ValueError, KeyError, TypeError):
            file.close()
            raise ScenarioError(f"{log}, line {number} is damaged; delete the file to start again") from None
    file.cut()
    return file, found
