"""Opens an engine where it is wanted, on this machine or on a Ray cluster: for all that runs policies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from lerobot_roborecover.evaluation.local_engine import open_local_engine
from lerobot_roborecover.evaluation.scheduler import Engine
from lerobot_roborecover.evaluation.session import EvalSession
from lerobot_roborecover.evaluation.sizes import default_slots
from lerobot_roborecover.evaluation.smoke import check_smoke
from lerobot_roborecover.evaluation.work_items import WorkItem, first_units
from lerobot_roborecover.policies.runner import PolicyRunner
from lerobot_roborecover.workers.backend import LOCAL, Backend, WorkerStartup
from lerobot_roborecover.workers.capacity import available_gb, usable_cores
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


def open_engine(
    run: EvalSession,
    units: Sequence[WorkItem],
    make_host: Callable[[], PolicyRunner],
    places: EngineConfig,
    *,
    stop: Callable[[], bool] = lambda: False,
    **options: Any,
) -> Engine:
    """Starts simulators, each of which makes its simulator first, and a picture where it is to draw; and the
    policy, once or several times.

    Args:
        run: pool, protocol, trial log.
        units: what will be run; not empty.
        make_host: loads the policy. For a cluster it must travel: a module's function, or a partial of one.
        places: where.
        stop: asked while a policy loads on this machine; True gives up.
        options: of `Engine`.

    Raises:
        CallStoppedError: `stop` came before the policy was loaded.
        OptionError: a cluster is not there, or lacks what is asked for.
        SimulatorError: no simulator can be made.
    """
    workplace, units = places.workplace, list(units)
    if not workplace.on_cluster:
        drawing = None
        if places.draws:
            drawing = render_environment(places.render_device, places.device, egl_devices())
        slots = places.slots or default_slots(places.device, usable_cores(), available_gb())
        return open_local_engine(run, units, make_host, slots, drawing, stop=stop, **options)
    from lerobot_roborecover.evaluation.ray_engine import open_ray_engine

    startup = WorkerStartup(first=("fingerprint", None), check=check_smoke)
    if places.draws:
        (first,) = first_units(units, 1)
        drawing = partial(node_drawing, places.render_device)
        startup = WorkerStartup(drawing, ("smoke", first.scenario), check_smoke)
    return open_ray_engine(
        run,
        make_host,
        workplace,
        slots=places.slots,
        replicas=places.replicas,
        gpus=1.0 if places.device.startswith("cuda") else 0.0,
        startup=startup,
        snapshot_dir=places.snapshot_dir,
        most=len(units),
        **options,
    )
