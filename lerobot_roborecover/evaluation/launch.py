"""Runs work items: the one way from a session to rows, for evaluation, screening, collecting and forks.

`run_work_items` leaves out what the trial log already holds, starts simulators and the policy on this machine
or on a Ray cluster, and runs the trials. Each caller says which work items, which policy, and what to do with
each finished trial.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import wait
from typing import Any

from lerobot_roborecover.evaluation.first_trials import FirstTrials
from lerobot_roborecover.evaluation.scheduler import Engine
from lerobot_roborecover.evaluation.session import EvalSession
from lerobot_roborecover.evaluation.work_items import WorkItem, first_units, unfinished
from lerobot_roborecover.platforms import SimulatorError
from lerobot_roborecover.policies.runner import InlineReplica, PolicyRunner
from lerobot_roborecover.policies.watchdog import CallStoppedError, PolicyThread
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.text import pluralize
from lerobot_roborecover.workers.backend import LOCAL, Backend, WorkerStartup
from lerobot_roborecover.workers.capacity import available_gb, default_slots, usable_cores
from lerobot_roborecover.workers.messages import SlotFailure
from lerobot_roborecover.workers.render_device import egl_devices, node_drawing, render_environment


@dataclass(frozen=True)
class EngineConfig:
    """Where an engine's simulators and policies are, and how many."""

    workplace: Backend = LOCAL
    slots: int = 0
    """Simulators at once; 0 takes as many as there is room for."""
    replicas: int = 0
    """Copies of the policy on a cluster; 0 takes one per GPU, or one for a policy on the CPU."""
    device: str = "cpu"
    """The policy's, as torch calls it."""
    draws: bool = False
    """Whether simulators make pictures."""
    render_device: str = "auto"
    """Where; see `render_environment`, and on a cluster `node_environment`."""
    snapshot_dir: str | None = None
    """On a cluster: folder of handoff snapshots that all nodes share."""


@dataclass(frozen=True)
class RunResult:
    """What a run of work items came to; the rows are in the trial log."""

    finished: int = 0
    """Trials that ended in this run."""
    reruns: int = 0
    """Trials that were restarted because a machine, the policy, or the connection to it was lost."""
    unrun: Mapping[tuple[str, int], str] = field(default_factory=dict)
    """Why trials were left for another run, by scenario and trial: the policy could not be reached, or an
    inference never ended."""

    @property
    def problem(self) -> str:
        """The trials that were left and why, as a sentence's end; empty where none was."""
        if not self.unrun:
            return ""
        (scenario, trial), reason = next(iter(self.unrun.items()))
        return f"trial {trial} of {scenario}: {reason}"

    def check_all_run(self) -> None:
        """Checks that no trial was left for another run.

        Raises:
            ScenarioError: some were; the same command goes on.
        """
        if self.unrun:
            raise ScenarioError(
                f"{pluralize(len(self.unrun), 'trial')} could not be run: the policy was away or hung "
                f"({self.problem}). What has finished is kept: once the policy answers, run the same command "
                "again"
            )


def run_work_items(
    run: EvalSession,
    items: Sequence[WorkItem],
    make_host: Callable[[], PolicyRunner],
    config: EngineConfig,
    *,
    stop: Callable[[], bool] = lambda: False,
    remedy: str = "",
    **options: Any,
) -> RunResult:
    """Runs the work items that the session's trial log does not hold yet; without any, nothing is started.
    A new run whose first trials all fail alike is stopped.

    Args:
        run: pool, protocol, trial log.
        items: trials to run.
        make_host: loads the policy. For a cluster it must travel: a module's function, or a partial of one.
        config: where, and how many at once.
        stop: asked between events; True starts no new trial and drops the running ones.
        remedy: what to do where the first trials all fail alike, as far as it is known.
        options: of `Engine`, such as `on_row`, which is called with every finished trial's row.

    Raises:
        OptionError: a cluster is not there, or lacks what is asked for.
        PolicyFailedError: the first trials ended in the same policy error, before any action.
        SimulatorError: no simulator can be made.
    """
    return run_passes(run, [items], make_host, config, stop=stop, remedy=remedy, **options)


def run_passes(
    run: EvalSession,
    passes: Iterable[Sequence[WorkItem]],
    make_host: Callable[[], PolicyRunner],
    config: EngineConfig,
    *,
    stop: Callable[[], bool] = lambda: False,
    remedy: str = "",
    most: int | None = None,
    **options: Any,
) -> RunResult:
    """`run_work_items` for several lists; simulators and policy are started once.

    Args:
        run, make_host, config, stop, remedy, options: of `run_work_items`.
        passes: lists of trials, each asked for once the one before has ended. After a trial that could not be
            run, none is asked for.
        most: trials in any list, at most; None takes the first list's.
    """
    engine, finished = None, 0
    for items in passes:
        todo = unfinished(run, items)
        if not todo:
            continue
        if engine is None:
            if not run.rows():  # of a run that goes on, the policy is known to act
                kind = run.protocol.policy_settings.get("policy_type")
                options["first"] = FirstTrials(len(todo), kind, remedy)
            try:
                engine = open_engine(run, todo, make_host, config, stop=stop, most=most, **options)
            except CallStoppedError:  # before the policy was loaded
                break
        finished += engine.run(todo, stop)
        if engine.unrun:
            break
    return RunResult() if engine is None else RunResult(finished, engine.reruns, engine.unrun)


def open_engine(
    run: EvalSession,
    units: Sequence[WorkItem],
    make_host: Callable[[], PolicyRunner],
    config: EngineConfig,
    *,
    stop: Callable[[], bool] = lambda: False,
    most: int | None = None,
    **options: Any,
) -> Engine:
    """Starts simulators, each of which makes its simulator first, and a picture where it is to draw; and the
    policy, once or several times.

    Args:
        run: pool, protocol, trial log.
        units: what will be run; not empty.
        make_host: loads the policy, as for `run_work_items`.
        config: where.
        stop: asked while a policy loads on this machine; True gives up.
        most: simulators that have something to do, at most; None takes one for each of `units`.
        options: of `Engine`.

    Raises:
        CallStoppedError: `stop` came before the policy was loaded.
        OptionError: a cluster is not there, or lacks what is asked for.
        SimulatorError: no simulator can be made.
    """
    if not config.workplace.on_cluster:
        return _open_local_engine(run, units, make_host, config, stop, most or len(units), options)
    from lerobot_roborecover.evaluation.ray_engine import open_ray_engine

    startup = WorkerStartup(first=("fingerprint", None), check=check_first_reply)
    if config.draws:
        (first,) = first_units(units, 1)
        drawing = partial(node_drawing, config.render_device)
        startup = WorkerStartup(drawing, ("smoke", first.scenario), check_first_reply)
    return open_ray_engine(
        run,
        make_host,
        config.workplace,
        slots=config.slots,
        replicas=config.replicas,
        gpus=1.0 if config.device.startswith("cuda") else 0.0,
        startup=startup,
        snapshot_dir=config.snapshot_dir,
        most=most or len(units),
        **options,
    )


def _open_local_engine(
    run: EvalSession,
    units: Sequence[WorkItem],
    make_host: Callable[[], PolicyRunner],
    config: EngineConfig,
    stop: Callable[[], bool],
    most: int,
    options: Mapping[str, Any],
) -> Engine:
    """Starts worker processes, has each make its first task and a picture while the policy loads in this
    process, and puts both together."""
    if config.draws:
        run.pool.configure(environment=render_environment(config.render_device, config.device, egl_devices()))
    slots = config.slots or default_slots(config.device, usable_cores(), available_gb())
    workers = run.pool.worker_slots(min(slots, most))
    begun = list(zip(workers, first_units(units, len(workers)), strict=False))
    for worker, unit in begun:
        worker.send(*(("smoke", unit.scenario) if config.draws else ("fingerprint",)))
    thread = PolicyThread()
    run.pool.on_close(thread.close)
    host = thread.call(make_host, stop=stop)
    # Where no simulator can be made the run is refused; if only some fail, their trials record the failure.
    replies = [worker.receive() for worker, _ in begun]
    check_first_reply(replies[0])
    return Engine(run, workers, [InlineReplica(host, thread, run.policy_watchdog_s)], wait, **options)


def check_first_reply(reply: object, where: str = "") -> None:
    """Refuses to begin a run whose simulators cannot be made, or cannot draw.

    Args:
        reply: a worker's to its first command, `smoke` or `fingerprint`.
        where: the machine, where there are several.

    Raises:
        SimulatorError: with the remedy.
    """
    if isinstance(reply, SlotFailure):
        place = f" on node {where}" if where else ""
        raise SimulatorError(
            f"the run was not begun, because the first simulator{place} failed: {reply.message}. "
            "'roborecover doctor' checks simulators and OpenGL; MUJOCO_GL=osmesa (of roborecover eval "
            "--runner.render_device=cpu) draws in software, and policies that need no pictures run with "
            "--env.obs_type=state"
        )
