"""The local engine: simulators in worker processes of this machine, the policy in this process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from multiprocessing.connection import wait
from typing import Any

from lerobot_roborecover.evaluation.scheduler import Engine, unfinished
from lerobot_roborecover.evaluation.session import EvalSession
from lerobot_roborecover.evaluation.smoke import check_smoke
from lerobot_roborecover.evaluation.work_items import WorkItem, first_units
from lerobot_roborecover.policies.policy_thread import PolicyThread
from lerobot_roborecover.policies.runner import InlineReplica, PolicyRunner


class LocalEngine(Engine):
    """Runs units on worker slots of the run's pool.

    Args:
        run: pool, protocol, trial log.
        host: the policy.
        slots: how many simulators.
        thread: where the policy infers; None makes one.
        options: of `Engine`.
    """

    def __init__(
        self,
        run: EvalSession,
        host: PolicyRunner,
        *,
        slots: int,
        thread: PolicyThread | None = None,
        **options: Any,
    ):
        if thread is None:
            thread = PolicyThread()
            run.pool.on_close(thread.close)
        replica = InlineReplica(host, thread, run.policy_watchdog_s)
        super().__init__(run, run.pool.worker_slots(slots), [replica], wait, **options)


def open_local_engine(
    run: EvalSession,
    units: list[WorkItem],
    make_host: Callable[[], PolicyRunner],
    slots: int,
    drawing: Mapping[str, str | None] | None,
    *,
    stop: Callable[[], bool] = lambda: False,
    **options: Any,
) -> LocalEngine:
    """Starts the simulators, has each make its first task and a picture while the policy loads, and puts both
    together.

    Args:
        run: pool, protocol, trial log.
        units: what will be run.
        make_host: loads the policy.
        slots: simulators at once, at most.
        drawing: environment variables that say where simulators draw; None where they draw nothing.
        stop: asked while the policy loads; True gives up.
        options: of `Engine`.

    Raises:
        CallStoppedError: `stop` came before the policy was loaded.
        SimulatorError: no simulator can be made.
    """
    if drawing is not None:
        run.pool.configure(environment=drawing)
    count = min(slots, len(units))
    begun = list(zip(run.pool.slots(count), first_units(unfinished(run, units), count), strict=False))
    for slot, unit in begun:
        slot.send(*(("fingerprint",) if drawing is None else ("smoke", unit.scenario)))
    thread = PolicyThread()
    run.pool.on_close(thread.close)
    host = thread.call(make_host, stop=stop)
    # Where no simulator can be made the run is refused; where only some break, it is their trials' affair.
    replies = [slot.receive() for slot, _ in begun]
    check_smoke(replies[0])
    return LocalEngine(run, host, slots=count, thread=thread, **options)
