"""Runs a study's evaluation: one run after the other, each of which goes on where it was."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

from lerobot_roborecover.analysis.make import Gallery, Report, report
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.evaluation.arms import (
    CANNOT_START,
    Arm,
    identity_of_run,
    run_program,
    stop_running,
    this_module,
)
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.determinism import has_kernels
from lerobot_roborecover.utils.text import output_end
from lerobot_roborecover.workers.capacity import SLOT_GB, available_gb, usable_cores
from recipes.study.arms import StudyArm, arms, report_command
from recipes.study.definition import StudyDefinition
from recipes.study.outcomes import (
    STEPS_BAND,
    ReproductionCheck,
    compare,
    outcomes_of,
    read_outcomes,
)

RUN_FILE = "run.yaml"
"""Beside the log of every arm: its run, as `roborecover eval --config_path` reads it."""
ARM_GB = 1.0
"""Memory reckoned for an arm beside its simulator: LeRobot, torch and a small policy."""
_SHOWN_LINES = 12
_NOT_OF_TRIALS = ("scenarios", "split", "select", "trial_log", "snapshot_dir")
"""Options of the env that do not decide how a trial ends."""


def scenario_ids(study: StudyDefinition, every: int) -> list[str]:
    """Every n-th scenario of the study's split, in the order of their ids.

    Raises:
        ScenarioError: the split is empty.
    """
    found = sorted(s.id for s in load_scenarios(study.scenarios, split=study.split))
    if not found:
        raise ScenarioError(f"{study.scenarios} has no scenario of the split {study.split!r}")
    return found[::every]


def evaluate(
    study: StudyDefinition,
    out: Path,
    every: int = 1,
    slots: int = 0,
    jobs: int = 0,
    say: Callable[[str], None] = print,
) -> list[StudyArm]:
    """Runs every arm that is not finished, once all of them can start.

    Args:
        study: what.
        out: folder of the results; a rerun goes on there.
        every: take every n-th scenario.
        slots: simulators at once in each arm; 0: as many as there are cores for it.
        jobs: arms at once; 0: one per core, as far as memory allows. A small policy keeps one core busy, and
            no second.
        say: takes progress lines.

    Returns:
        The arms, all finished.

    Raises:
        ScenarioError: an arm cannot start, or failed; the message has the end of its output. Arms under way
            end first.
    """
    ids = scenario_ids(study, every)
    cores = usable_cores()
    jobs = jobs or max(1, min(cores, int(min(available_gb(), 1e6) / (ARM_GB + SLOT_GB))))
    todo = list(arms(study, out, ids if every > 1 else (), slots or max(cores // jobs, 1)))

    check_arms([arm for arm in todo if not run_of(arm, study, ids).finished()], study, out)

    def run(arm: StudyArm) -> float:
        began = time.monotonic()
        run_arm(arm, study, ids, say)
        return time.monotonic() - began

    with ThreadPoolExecutor(jobs) as pool:
        running = {pool.submit(run, arm): arm for arm in todo}
        try:
            for number, finished in enumerate(as_completed(running), 1):
                arm, seconds = running[finished], finished.result()
                say(f"[{number}/{len(todo)}] {arm.label}: {len(ids) * arm.trials} trials, {seconds:.0f} s")
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            stop_running()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    return todo


def compare_with_stored(study: StudyDefinition, done: Sequence[StudyArm]) -> ReproductionCheck | None:
    """Today's outcomes against the stored ones, to the step where this processor can take the kernels that
    the study names; None where nothing is stored."""
    if not study.outcomes.exists():
        return None
    band = 0 if has_kernels() else STEPS_BAND
    return compare(read_outcomes(study.outcomes), outcomes_of(done), band)


def write_report(study: StudyDefinition, done: Sequence[StudyArm], out: Path) -> Report:
    """Writes the report page of the arms' logs."""
    options = Options(baseline=study.base, interventions=tuple(study.interventions))
    return report(
        [f"{arm.name}={arm.log}" for arm in done],
        out / "report",
        options=options if study.interventions else None,
        gallery=Gallery(str(study.scenarios)),
        command=report_command(study, done, out),
    )


def check_arms(waiting: Sequence[StudyArm], study: StudyDefinition, out: Path) -> None:
    """Loads what the arms will load, so that one that cannot start is known before the first trial of any.

    Raises:
        ScenarioError: which cannot, and why.
    """
    if not waiting:
        return
    for arm in waiting:
        arm.run.write(arm.out / RUN_FILE)
    runs = [str(arm.out / RUN_FILE) for arm in waiting]
    log = out / "trials" / "startable.log"
    log.unlink(missing_ok=True)
    status = run_program([*this_module("recipes.study.startable"), *runs], study.environment, log)
    if status:
        output = log.read_text(errors="replace")
        told = [f"  {line}" for line in output.splitlines() if line.startswith(CANNOT_START)]
        shown = "\n".join(told) or output_end(output, _SHOWN_LINES)[1]
        raise ScenarioError(
            f"not every arm can start, and none was begun ({log} says more):\n{shown}\n"
            "Put right what is named, and run the same command again"
        )


def run_arm(
    arm: StudyArm, study: StudyDefinition, ids: Sequence[str], say: Callable[[str], None] = print
) -> None:
    """Runs an arm, unless it has finished.

    Raises:
        ScenarioError: it failed; the message has the end of its output.
    """
    arm.run.write(arm.out / RUN_FILE)
    run_of(arm, study, ids).run(say)


def run_of(arm: StudyArm, study: StudyDefinition, ids: Sequence[str]) -> Arm:
    """An arm's run in a process of its own, which rounds as the study says; its output goes into a file."""
    # With other slots or snapshots the trials are the same: what has finished is not run again for them.
    env = {k: v for k, v in arm.run.env.items() if k != "snapshot_dir"}
    same = replace(arm.run, env=env, runner={**arm.run.runner, "slots": 0}).config()
    return Arm(
        arm.label, arm.log, ["eval", f"--config_path={arm.out / RUN_FILE}"], _identity(arm),
        decides=[same, list(ids)], environment=study.environment, output=arm.out / "output.log",
    )  # fmt: skip


def _identity(arm: StudyArm) -> dict[str, Any]:
    """What all rows of an arm's log share: its policy's files and options, the env's options, and so on."""
    run = arm.run
    env = {k: v for k, v in run.env.items() if k not in _NOT_OF_TRIALS}
    stored = {"cross_cpu_deterministic": "portable"}  # names in the identities of earlier runs
    runner = {stored.get(k, k): v for k, v in run.runner.items() if k != "slots"}
    return identity_of_run(
        run.platform, run.policy, env=env, runner=runner, seed=run.seed, rename_map=dict(run.rename_map)
    )
