"""Steps a second of 8 to 256 simulators on 1 to 8 GPUs, on a clock of its own: what limits them.

    python benchmarks/eval_throughput.py --picture docs/images/throughput.svg
    python benchmarks/eval_throughput.py --fixed-ms 40 --each-ms 1 --look-ms 3 --cores 16

The engine runs as it is (benchmarks/eval_schedule.py); simulators and policies only say how long they take.
Each GPU has a run of its own with its share of the simulators and of the scenarios (`--env.shard=k/n`), and
cores of its own. Beside it LeRobot's loop: as many environments in lock-step, worked out, not run. No number
here is measured on a GPU: put in yours.

Where the defaults are from: 73 ms are pi0's 10 denoising steps on an RTX 4090 (Black et al. 2024, arXiv
2410.24164, appendix D); 2 ms more for each observation in a batch are vla-eval's 486 observations a second on
one H100 (arXiv 2603.13966), of another model; 12 ms are LIBERO's step without a picture on one core
(docs/log/performance.md); 10 ms for two pictures are a guess.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from scipy import stats

from lerobot_roborecover.evaluation.scheduler import Engine
from lerobot_roborecover.evaluation.session import EvalSession
from lerobot_roborecover.evaluation.work_items import units_of
from lerobot_roborecover.logs.row import EvalProtocol
from lerobot_roborecover.policies.runner import InlineReplica
from tests.support.factories import fake_scenario
from tests.support.virtual_time import VirtualHost, VirtualSlot, World

JITTER = 0.03
VLA_EVAL = 486.0
"""Observations a second, each after one step: 2,000 episodes in 18 minutes are 262 of them an episode."""


@dataclass(frozen=True)
class Times:
    """What a machine with one GPU takes, and has."""

    step_s: float
    look_s: float
    """Of an observation's pictures, on the simulator's core."""
    fixed_s: float
    """Of an inference."""
    each_s: float
    """More for each observation in it."""
    cores: int
    executed: int
    """Actions per inference."""
    horizon: int
    max_batch: int


@dataclass(frozen=True)
class Throughput:
    """Of one GPU and its simulators."""

    steps_per_s: float
    batch: float
    policy_busy: float
    cores_busy: float

    @property
    def limit(self) -> str:
        """What is busy nearly all the time; else each waits for the other."""
        if self.policy_busy > 0.9:
            return "policy"
        return "cores" if self.cores_busy > 0.9 else "too few simulators"


def of_engine(slots: int, times: Times, trials: int) -> Throughput:
    """The engine on a virtual clock; horizons from 70 % of the given one to all of it."""
    world = World(times.cores, times.step_s, JITTER, times.look_s)
    host = VirtualHost(world, times.fixed_s, times.each_s, times.executed, times.max_batch)
    rng, base = np.random.default_rng(0), fake_scenario(0)
    scenarios = [
        replace(
            base, id=f"s{k:03d}", fingerprint=None,
            task=replace(base.task, horizon=int(rng.integers(0.7 * times.horizon, times.horizon + 1))),
        )
        for k in range(slots)
    ]  # fmt: skip
    run = EvalSession(None, EvalProtocol("recovery", 0, "p", 0, times.executed), None, "d", None)
    workers = [VirtualSlot(world) for _ in range(slots)]
    engine = Engine(run, workers, [InlineReplica(host)], world.wait, clock=world.clock)
    assert engine.run(units_of(scenarios, trials)) == slots * trials
    steps = trials * sum(s.task.horizon for s in scenarios)
    return Throughput(
        steps / world.now, statistics.mean(host.batches), host.busy_s / world.now,
        world.core_s / world.now / times.cores,
    )  # fmt: skip


def of_lock_step(envs: int, times: Times) -> float:
    """Steps a second of LeRobot's loop: all environments step and draw, then all are asked; everybody waits
    for the slowest of every step, and for the longest trial, here all of one length."""
    slowest = 1 + JITTER * (stats.norm.ppf(1 - 1 / (envs + 1)) if envs > 1 else 0.0)
    step_s = (times.step_s + times.look_s) * max(1.0, envs / times.cores) * slowest
    inference_s = sum(
        times.fixed_s + times.each_s * min(times.max_batch, envs - begin)
        for begin in range(0, envs, times.max_batch)
    )
    return envs / (step_s + inference_s / times.executed)


def draw(path: Path, found: dict[int, Throughput], locked: dict[int, float], gpus: list[int]) -> None:
    """Steps a second by simulators, a line for each number of GPUs."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4))
    for colour, count in enumerate(gpus):
        at = [n * count for n in found if 8 <= n * count <= 256]
        axes.plot(at, [count * found[n // count].steps_per_s for n in at], "o-", ms=3, c=f"C{colour}",
                  label=f"{count} GPU{'s' * (count > 1)}")  # fmt: skip
        axes.plot(at, [count * locked[n // count] for n in at], "--", lw=0.9, c=f"C{colour}")
    axes.axhline(VLA_EVAL, c="0.5", lw=0.9, ls=":")
    axes.text(
        256, VLA_EVAL * 0.86, "vla-eval, published, 1 H100, another model", fontsize=7, c="0.4", ha="right"
    )
    axes.plot([], [], "--", c="0.4", lw=0.9, label="LeRobot's loop, worked out")
    axes.set(xscale="log", yscale="log", xlabel="simulators", ylabel="policy steps a second")
    axes.set_xticks([8, 16, 32, 64, 128, 256], ["8", "16", "32", "64", "128", "256"])
    axes.minorticks_off()
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8, frameon=False)
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--step-ms", type=float, default=12.0)
    add("--look-ms", type=float, default=10.0, help="of all cameras of a simulator")
    add("--fixed-ms", type=float, default=73.0, help="of an inference")
    add("--each-ms", type=float, default=2.0, help="more for each observation in it")
    add("--cores", type=int, default=24, help="for the simulators of each GPU")
    add("--executed", type=int, default=10, help="actions per inference")
    add("--horizon", type=int, default=200)
    add("--max-batch", type=int, default=64)
    add("--trials", type=int, default=3, help="of each simulator")
    add("--gpus", type=int, nargs="+", default=[1, 2, 4, 8])
    add("--simulators", type=int, nargs="+", default=[8, 16, 32, 64, 128, 256])
    add("--picture", type=Path)
    args = parser.parse_args()
    times = Times(
        args.step_ms / 1e3, args.look_ms / 1e3, args.fixed_ms / 1e3, args.each_ms / 1e3, args.cores,
        args.executed, args.horizon, args.max_batch,
    )  # fmt: skip
    each = sorted({n // g for n in args.simulators for g in args.gpus if n % g == 0})
    found, locked = {}, {}
    print("simulators per GPU | steps/s | batch | policy busy | cores busy | limit | LeRobot's loop, steps/s")
    for slots in each:
        found[slots], locked[slots] = of_engine(slots, times, args.trials), of_lock_step(slots, times)
        one = found[slots]
        print(f"{slots:4} | {one.steps_per_s:7.0f} | {one.batch:5.1f} | {one.policy_busy:4.0%} | "
              f"{one.cores_busy:4.0%} | {one.limit} | {locked[slots]:.0f}", flush=True)  # fmt: skip
    print("\nsteps/s, simulators down, GPUs across:", *args.gpus)
    for n in args.simulators:
        row = [g * found[n // g].steps_per_s if n % g == 0 else math.nan for g in args.gpus]
        print(f"{n:4} | " + " | ".join(f"{rate:.0f}" for rate in row))
    if args.picture:
        draw(args.picture, found, locked, args.gpus)


if __name__ == "__main__":
    main()
