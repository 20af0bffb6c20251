"""What the benchmarks of the engine share: a policy that costs what it is told to, a run, readings of it."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.evaluation.launch import EngineConfig, open_engine
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.session import SimulatorSpec, create_session
from lerobot_roborecover.evaluation.work_items import units_of
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.scenario import Reset, Scenario, Task
from lerobot_roborecover.workers.messages import EpisodeSpec, SlotConfig, SlotFailure
from lerobot_roborecover.workers.slots import WorkerSlot


class StubHost:
    """Gives every slot the same chunk of small random actions, after `latency_s`.

    Args:
        width: of an action.
        chunk: actions per inference.
        latency_s: of a batch, whatever its size; inferences that take none are not recorded.
    """

    max_batch, batched = 64, True

    def __init__(self, width: int, chunk: int = 10, latency_s: float = 0.0):
        rng = np.random.default_rng(0)
        self._chunk = rng.uniform(-0.1, 0.1, (chunk, width)).astype(np.float32)
        self._latency_s = latency_s
        self.calls: list[tuple[float, float, int]] = []
        self.started = threading.Event()

    def noise(self, seed: int | None) -> str:
        """Nothing is drawn."""
        return "per_trial"

    def start(self, seed: int | None) -> None:
        """There is no history."""

    def finish(self, history: None) -> None:
        """Nothing to give back."""

    def act(self, observations: list, instructions: list[str], histories: list) -> list[np.ndarray]:
        """The chunk, for everyone."""
        began = time.perf_counter()
        self.started.set()
        if self._latency_s:
            time.sleep(self._latency_s)
            self.calls.append((began, time.perf_counter(), len(observations)))
        return [self._chunk] * len(observations)


def run_engine(
    scenarios: list[Scenario] | Path,
    slot: SlotConfig,
    host: StubHost,
    *,
    slots: int,
    trials: int,
    observe: Callable | None = None,
    spent: Callable | None = None,
) -> tuple[float, list[int]]:
    """Seconds of a run on warm workers, and the steps of its trials.

    Args:
        scenarios: what to run, or a dataset's folder.
        slot: the simulators'.
        host: the policy.
        slots: how many simulators.
        trials: of each scenario.
        observe: called with every (slot number, began, ended) of a simulator's work.
        spent: called with the run's CPU seconds in this process and in the simulators, and with the largest
            resident memory of a simulator, MB.
    """
    with tempfile.TemporaryDirectory() as folder:
        root = scenarios
        if not isinstance(root, Path):
            root = write_scenarios(Path(folder) / "set", scenarios)
        options = RecoveryOptions(
            scenarios=str(root), trial_log=f"{folder}/log.jsonl", strict_versions=False, handoff_check=False
        )
        loaded, run = create_session(
            options,
            SimulatorSpec(slot, {}, None),
            workers=True,
            facts=PolicyMetadata("stub", n_episodes=trials),
        )
        run.protocol = replace(run.protocol, run_seed=0)
        run.pool.acquire()
        rows = []
        try:
            pool = run.pool.slots(slots)
            for number, each in enumerate(pool):
                each.send("reset", EpisodeSpec(loaded[number % len(loaded)], "recovery", 0, False))
            for each in pool:
                assert not isinstance(reply := each.receive(), SlotFailure), reply
            units = units_of(list(loaded), trials)
            engine = open_engine(
                run, units, lambda: host, EngineConfig(slots=slots), on_row=lambda row: rows.append(row.steps)
            )
            if observe is not None:
                for number, each in enumerate(pool):
                    watch(each, number, observe)
            cpu = time.process_time(), sum(process_cpu_s(each.pid) for each in pool)
            began = time.perf_counter()
            engine.run(units)
            seconds = time.perf_counter() - began
            if spent is not None:
                own, simulators = time.process_time(), sum(process_cpu_s(each.pid) for each in pool)
                spent((own - cpu[0], simulators - cpu[1], max(process_peak_mb(each.pid) for each in pool)))
            return seconds, rows
        finally:
            run.pool.release()


def process_cpu_s(pid: int) -> float:
    """CPU seconds of all threads of a process."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9


def process_peak_mb(pid: int) -> float:
    """Largest resident memory of a process so far."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def watch(slot: WorkerSlot, number: int, observe: Callable) -> None:
    """Reports when a slot works: from a command to the moment its reply is fetched, less what it waited."""
    send, receive = slot.send, slot.receive

    def timed_send(command, argument=None):
        slot.began = time.perf_counter()
        send(command, argument)

    def timed_receive():
        reply = receive()
        seconds = getattr(reply, "seconds", None)
        if seconds is None:
            seconds = getattr(getattr(reply, "handoff", None), "seconds", 0.0)
        observe(number, slot.began, slot.began + seconds)
        return reply

    slot.send, slot.receive = timed_send, timed_receive


def short(scenario: Scenario, horizon: int) -> Scenario:
    """The scenario with fewer steps for the policy."""
    return replace(scenario, task=replace(scenario.task, horizon=horizon), fingerprint=None)


def fake_scenario(index: int, horizon: int) -> Scenario:
    """One of the fake simulator's, without a fingerprint."""
    prefix = np.random.default_rng(index).uniform(-1, 1, (10, 2))
    return Scenario(
        f"fake-{index:05d}", Task("fake", "toy", "push-left", "push", horizon), Reset(seed=index), prefix,
        "Approach", "Wrong Pose", "natural",
    )  # fmt: skip
