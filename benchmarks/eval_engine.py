"""The engine by itself: simulators' limit, handoffs, growth, start-up, and a slow policy.

    python benchmarks/eval_engine.py limit        # LIBERO: env steps per second over bare steps and renders
    python benchmarks/eval_engine.py handoff      # LIBERO: snapshot against replay, 200-step prefix
    python benchmarks/eval_engine.py growth       # fake: time per trial and memory, 20 to 2,000 scenarios
    python benchmarks/eval_engine.py startup      # LIBERO: from the command to the first policy step
    python benchmarks/eval_engine.py overlap --picture timeline.svg    # a policy of 100 ms a batch

Policies here cost nothing, or a stated time, so that what is measured is the engine. Every comparison is made
within one run.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from engine_parts import (
    StubHost,
    fake_scenario,
    process_peak_mb,
    run_engine,
    short,
)

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.evaluation.launch import EngineConfig, run_work_items
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.session import SimulatorSpec, create_session
from lerobot_roborecover.evaluation.work_items import units_of
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.replay.handoff import SnapshotCache, hand_off
from lerobot_roborecover.workers.messages import EpisodeSpec, SlotConfig, SlotFailure
from lerobot_roborecover.workers.slots import WorkerSlot

STEP_S = 0.011
"""A simulator's step in `overlap`: LIBERO's, without a picture."""


# --- the measurements; each returns its numbers


def limit(args: argparse.Namespace) -> dict:
    """Two LIBERO simulators under the engine, and the same two on their own, in turns."""
    scenarios = [short(s, args.steps) for s in load_scenarios("libero_starter", select="suite=libero_goal")]
    scenarios = scenarios[: args.slots]
    config = SlotConfig("libero", {"observation_height": args.size, "observation_width": args.size})
    chunk = StubHost(7)._chunk
    ratios, rates, shares = [], [], []
    for _ in range(args.repeat):
        before = cpu_s()
        seconds, rows = run_engine(scenarios, config, StubHost(7), slots=args.slots, trials=args.trials)
        mine, simulators = (b - a for a, b in zip(before, cpu_s(), strict=True))
        shares.append(simulators / (mine + simulators))
        engine = sum(rows) / seconds
        bare = bare_rate(scenarios, config, chunk, args)
        ratios.append(engine / bare)
        rates.append((engine, bare))
        print(
            f"engine {engine:.1f} steps/s, bare {bare:.1f} steps/s, ratio {ratios[-1]:.2f}, "
            f"simulators' share of CPU time {shares[-1]:.3f}",
            flush=True,
        )
    return {"ratio": statistics.median(ratios), "rates": rates, "cpu_share": statistics.median(shares)}


def cpu_s() -> tuple[float, float]:
    """CPU seconds of this process, and of its children that have ended."""
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime, children.ru_utime + children.ru_stime


def bare_rate(scenarios, config, chunk, args) -> float:
    """Steps per second of workers that repeat the trials' steps without the engine."""
    slots = [WorkerSlot(config, 600.0) for _ in range(args.slots)]
    specs = [EpisodeSpec(s, "recovery", 0, False) for s in scenarios]
    for slot, spec in zip(slots, specs, strict=True):
        slot.send("reset", spec)
    for slot in slots:
        assert not isinstance(reply := slot.receive(), SlotFailure), reply
    done = []

    def work(slot, spec):
        for _ in range(args.trials):
            slot.send("reset", spec)
            slot.receive()
            for _ in range(args.steps // len(chunk)):
                slot.send("act", chunk)
                done.append(slot.receive().steps)

    threads = [threading.Thread(target=work, args=pair) for pair in zip(slots, specs, strict=True)]
    began = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    seconds = time.perf_counter() - began
    for slot in slots:
        slot.close()
    return sum(done) / seconds


def handoff(args: argparse.Namespace) -> dict:
    """The state a policy takes over, from a replay and from a snapshot; no picture on either side."""
    simulator = make_simulator("libero", obs_type="state")
    rows = []
    for scenario in list(load_scenarios("libero_starter"))[:: args.every][: args.repeat]:
        prefix = np.resize(scenario.prefix, (200, 7))
        scenario = replace(scenario, prefix=prefix, fingerprint=None)
        hand_off(simulator, scenario, check=False)  # compiles the task
        replayed = hand_off(simulator, scenario, check=False)
        cache = SnapshotCache()
        hand_off(simulator, scenario, check=False, cache=cache)
        restored = [hand_off(simulator, scenario, check=False, cache=cache) for _ in range(5)]
        assert all(r.from_snapshot and r.state_sha256 == replayed.state_sha256 for r in restored)
        rows.append((replayed.seconds, statistics.median(r.seconds for r in restored)))
        print(f"{scenario.id}: replay {rows[-1][0]:.2f} s, snapshot {1e3 * rows[-1][1]:.1f} ms", flush=True)
    simulator.close()
    return {
        "replay_s": statistics.median(r for r, _ in rows),
        "snapshot_s": statistics.median(s for _, s in rows),
        "ratio": statistics.median(r / s for r, s in rows),
    }


def growth(args: argparse.Namespace) -> dict:
    """Each size in a process of its own, in turns: time per trial, and the largest resident memory.

    Every scenario gets the same number of trials at every size, so that a trial is as often its scenario's
    first (whose prefix is replayed) in a small run as in a large one; and small runs are repeated until they
    have as many trials as `--units` says, so that the beginning and the end of a run weigh the same.
    """
    runs: dict[int, list[dict]] = {count: [] for count in args.counts}
    with tempfile.TemporaryDirectory() as folder:
        for count in args.counts:
            write_scenarios(Path(folder) / str(count), [fake_scenario(i, 40) for i in range(count)])
        for count in args.counts * args.repeat:
            command = [sys.executable, __file__, "growth-one", "--set", f"{folder}/{count}"]
            command += ["--units", str(args.units), "--trials", str(args.trials)]
            result = subprocess.run(command, capture_output=True, text=True, check=True)
            runs[count].append(json.loads(result.stdout.splitlines()[-1]))
            print(count, runs[count][-1], f"load {os.getloadavg()[0]:.1f}", flush=True)
    medians = {c: {k: statistics.median(r[k] for r in each) for k in each[0]} for c, each in runs.items()}
    for name in medians[args.counts[0]]:
        values = [m[name] for m in medians.values()]
        print(f"{name}: {values}, largest over smallest size {values[-1] / values[0]:.3f}")
    return medians


def growth_one(args: argparse.Namespace) -> dict:
    """One size of `growth`, on a set that another process has written."""
    seconds = trials = 0
    spent: list[tuple[float, float, float]] = []
    while trials < args.units:
        took, done = run_engine(
            args.set, SlotConfig("fake"), StubHost(2), slots=2, trials=args.trials, spent=spent.append
        )
        seconds, trials = seconds + took, trials + len(done)
    return {
        "ms_per_trial": 1e3 * seconds / trials,
        "cpu_ms_per_trial": 1e3 * sum(own + simulators for own, simulators, _ in spent) / trials,
        "peak_mb": process_peak_mb(os.getpid()),  # rusage would count what the parent had before exec
        "simulator_peak_mb": max(peak for *_, peak in spent),
    }


def startup(args: argparse.Namespace) -> dict:
    """From a fresh interpreter to the first inference."""
    times = []
    for _ in range(args.repeat):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        began = time.perf_counter()
        subprocess.run(
            [sys.executable, __file__, "startup-one", "--size", str(args.size)],
            check=True, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        seconds = time.perf_counter() - began
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        times.append((seconds, cpu))
        print(f"{seconds:.1f} s, {cpu:.1f} s of CPU time, simulators included", flush=True)
    return {
        "seconds": statistics.median(t for t, _ in times),
        "cpu_s": statistics.median(c for _, c in times),
    }


def startup_one(args: argparse.Namespace) -> dict:
    """Ends at the first inference of a run of one whole LIBERO suite."""
    scenarios = list(load_scenarios("libero_starter", select="suite=libero_goal"))
    config = SlotConfig("libero", {"observation_height": args.size, "observation_width": args.size})
    with tempfile.TemporaryDirectory() as folder:
        root = write_scenarios(Path(folder) / "set", scenarios)
        options = RecoveryOptions(scenarios=str(root), trial_log=f"{folder}/log.jsonl", strict_versions=False)
        loaded, run = create_session(
            options, SimulatorSpec(config, {}, None), workers=True, facts=PolicyMetadata("stub", n_episodes=1)
        )
        host = StubHost(7)
        run.pool.acquire()
        run_work_items(
            run, units_of(list(loaded), 1), lambda: host, EngineConfig(slots=2), stop=host.started.is_set
        )
        run.pool.release()
    return {}


def overlap(args: argparse.Namespace) -> dict:
    """Simulators of 11 ms a step on `--cores` cores, under a policy of `--latency` s a batch.

    Steps and inferences are sleeps, and a core is a lock that a step holds, so that this machine's own cores
    decide nothing. The bound is max(simulator time / cores, policy time), with the batches as they were.
    """
    runs = []
    for k in range(args.repeat):
        runs.append(overlap_one(args, args.picture if k == 0 else None))
        print({n: round(v, 3) for n, v in runs[-1].items()}, f"load {os.getloadavg()[0]:.1f}", flush=True)
    return {name: statistics.median(r[name] for r in runs) for name in runs[0]}


def overlap_one(args: argparse.Namespace, picture: Path | None) -> dict:
    """One run of `overlap`."""
    spans: list[tuple[int, float, float]] = []
    host = StubHost(2, latency_s=args.latency)
    scenarios = [fake_scenario(i, 100) for i in range(args.slots)]
    with tempfile.TemporaryDirectory() as folder:
        config = SlotConfig("fake", {"step_s": STEP_S, "cores": (folder, args.cores)})
        seconds, steps = run_engine(
            scenarios, config, host, slots=args.slots, trials=args.trials, observe=lambda *s: spans.append(s)
        )
    # What the simulators did, without what they waited for a core: a trial's steps, and the one step after
    # its snapshot.
    simulators = (sum(steps) + len(steps)) * STEP_S / args.cores
    policy = sum(end - began for began, end, _ in host.calls)
    chunks = sum(size for *_, size in host.calls)
    chain = (chunks * args.latency + (sum(steps) + len(steps)) * STEP_S) / args.slots
    if picture:
        draw(spans, host.calls, args, picture)
    return {
        "trials": len(steps), "wall_s": seconds, "simulators_s": simulators, "policy_s": policy,
        "over_bound": seconds / max(simulators, policy), "over_chain": seconds / chain,
        "ms_per_chunk": 1e3 * seconds / chunks, "mean_batch": chunks / len(host.calls),
        "cores_busy": simulators / seconds, "policy_busy": policy / seconds,
    }  # fmt: skip


def draw(spans: list, calls: list, args: argparse.Namespace, picture: Path) -> None:
    """Who worked when, over some seconds in the middle of the run."""
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot

    middle = statistics.median(began for _, began, _ in spans)
    figure, axes = pyplot.subplots(figsize=(9, 0.3 * args.slots + 1.4))
    for number in range(args.slots):
        mine = [(b - middle, e - b) for n, b, e in spans if n == number and 0 <= b - middle < 3]
        axes.broken_barh(mine, (args.slots - number - 0.4, 0.8), color="#4c78a8")
    asked = [(b - middle, e - b) for b, e, _ in calls if 0 <= b - middle < 3]
    axes.broken_barh(asked, (-0.4, 0.8), color="#f58518")
    names = ["policy", *(f"simulator {n}" for n in range(args.slots - 1, -1, -1))]
    axes.set_yticks(range(len(names)), names)
    axes.set_xlabel("seconds")
    axes.set_xlim(0, 3)
    figure.tight_layout()
    figure.savefig(picture)


def main() -> None:
    """Measures one thing and prints its numbers as JSON on the last line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "what",
        choices=["limit", "handoff", "growth", "growth-one", "startup", "startup-one", "overlap"],
    )
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--size", type=int, default=256, help="side of the pictures, pixels")
    parser.add_argument("--slots", type=int, default=2)
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--steps", type=int, default=40, help="horizon of `limit`")
    parser.add_argument("--every", type=int, default=5, help="`handoff` takes every n-th scenario")
    parser.add_argument("--counts", type=int, nargs="+", default=[20, 200, 2000])
    parser.add_argument("--set", type=Path, help="dataset folder of `growth-one`")
    parser.add_argument("--units", type=int, default=2000, help="least trials of a size of `growth`")
    parser.add_argument("--cores", type=int, default=8, help="simulators of `overlap` that step at once")
    parser.add_argument("--latency", type=float, default=0.1)
    parser.add_argument("--picture", type=Path, help="where `overlap` draws its timeline")
    args = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "egl")
    print(json.dumps(globals()[args.what.replace("-", "_")](args)))


if __name__ == "__main__":
    main()
