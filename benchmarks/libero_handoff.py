"""LIBERO: from a trial's start to the first policy observation, against the plain way, in one run.

The plain way is a stock LeRobot LIBERO env whose `step` replays the prefix. Both sides use one process, the
same scenarios and the same picture size; what is reported are medians and their ratios.

    python benchmarks/libero_handoff.py                 # a few minutes
    python benchmarks/libero_handoff.py --whole         # also 20 scenarios x 2 trials, plain and ours: much
    longer
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.workers.messages import EpisodeSpec, EpisodeStart, SlotConfig
from lerobot_roborecover.workers.slots import WorkerSlot

PREFIX_STEPS = 150


class Plain:
    """A stock LeRobot LIBERO env per scenario; the prefix goes through its `step`."""

    def __init__(self, size: int):
        from lerobot_roborecover.platforms.libero.assets import find_assets, quiet_import

        quiet_import(find_assets())  # LIBERO would ask where to keep data sets
        from lerobot.envs.libero import LiberoEnv, _get_suite

        self._env_class, self._get_suite, self._size = LiberoEnv, _get_suite, size
        self._env = None
        self._scenario_id = ""

    def hand_off(self, scenario: Scenario) -> dict:
        """Resets, replays, returns the first policy observation; makes the env on a scenario's first
        trial."""
        if self._scenario_id != scenario.id:
            self.close()
            suite = self._get_suite(scenario.task.suite)
            names = [task.name for task in suite.tasks]
            self._env = self._env_class(
                suite, names.index(scenario.task.name), scenario.task.suite, obs_type="pixels_agent_pos",
                observation_width=self._size, observation_height=self._size, num_steps_wait=0,
            )  # fmt: skip
            self._scenario_id = scenario.id
        self._env.init_state_id = scenario.reset.init_state_index
        observation, _ = self._env.reset(seed=scenario.reset.seed)
        for action in scenario.prefix:
            observation = self._env.step(action)[0]
        return observation

    def step(self, action: np.ndarray) -> dict:
        """One policy step."""
        return self._env.step(action)[0]

    def close(self) -> None:
        """Frees the env."""
        if self._env is not None:
            self._env.close()
            self._env = None


class Ours:
    """One worker slot, as `lerobot-eval` uses them."""

    def __init__(self, size: int, snapshots: str | None = None):
        options = {"observation_height": size, "observation_width": size}
        began = time.perf_counter()
        self._slot = WorkerSlot(SlotConfig("libero", options, snapshots), timeout_s=600)
        self.ask("spaces")
        self.start_s = time.perf_counter() - began

    def ask(self, command: str, argument: object = None):
        """One command and its reply."""
        self._slot.send(command, argument)
        return self._slot.receive()

    def hand_off(self, scenario: Scenario) -> EpisodeStart:
        """The trial's start."""
        reply = self.ask("reset", EpisodeSpec(scenario, "recovery", 0, True))
        assert isinstance(reply, EpisodeStart), reply
        return reply

    def step(self, action: np.ndarray):
        """One policy step."""
        return self.ask("step", action)

    def memory_mb(self) -> float:
        """Resident memory of the worker, MB."""
        status = Path(f"/proc/{self._slot.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0]) / 1024

    def close(self) -> None:
        """Ends the worker."""
        self._slot.close()


def timed(call: Callable[[], object]) -> float:
    """Seconds of one call."""
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def cut(scenario: Scenario, steps: int) -> Scenario:
    """The scenario with its prefix cut, or continued with its last action, to `steps`."""
    prefix = scenario.prefix[:steps]
    if len(prefix) < steps:
        prefix = np.concatenate([prefix, np.repeat(prefix[-1:], steps - len(prefix), axis=0)])
    return replace(scenario, prefix=prefix, fingerprint=None)


def handoffs(scenarios: list[Scenario], size: int, later: int) -> dict:
    """First and later trials, plain and ours, interleaved scenario by scenario."""
    plain, ours = Plain(size), Ours(size)
    rows: dict[str, list[float]] = {k: [] for k in ("plain_first", "plain_later", "ours_first", "ours_later")}
    for scenario in scenarios:
        rows["plain_first"].append(timed(lambda s=scenario: plain.hand_off(s)))
        rows["ours_first"].append(timed(lambda s=scenario: ours.hand_off(s)))
        rows["plain_later"].append(timed(lambda s=scenario: plain.hand_off(s)))
        rows["ours_later"] += [timed(lambda s=scenario: ours.hand_off(s)) for _ in range(later)]
        print({k: round(v[-1], 2) for k, v in rows.items()}, flush=True)
    action = np.zeros(7, np.float32)
    step = {
        "plain": statistics.median(timed(lambda: plain.step(action)) for _ in range(20)),
        "ours_rendered": statistics.median(timed(lambda: ours.step(action)) for _ in range(20)),
    }
    result = {k: statistics.median(v) for k, v in rows.items()}
    result |= {f"step_{k}_ms": 1e3 * v for k, v in step.items()}
    result |= {"worker_start_s": ours.start_s, "worker_memory_mb": ours.memory_mb()}
    plain.close()
    ours.close()
    return result


def bare_step_ms(scenario: Scenario) -> float:
    """Milliseconds of a step that renders nothing."""
    from lerobot_roborecover.platforms import make_simulator

    simulator = make_simulator("libero", obs_type="state")
    simulator.reset(scenario.task, scenario.reset)
    times = [timed(lambda a=action: simulator.step(a)) for action in scenario.prefix]
    simulator.close()
    return 1e3 * statistics.median(times)


def whole(scenarios: list[Scenario], trials: int, policy_steps: int, size: int) -> dict:
    """All trials of all scenarios, each with `policy_steps` observed steps after its handoff."""
    action = np.zeros(7, np.float32)
    seconds = {}
    for name, side in (("ours", Ours(size)), ("plain", Plain(size))):
        began = time.perf_counter()
        for number, scenario in enumerate(scenarios, 1):
            for _ in range(trials):
                side.hand_off(scenario)
                for _ in range(policy_steps):
                    side.step(action)
            print(f"{name}: {number}/{len(scenarios)}, {time.perf_counter() - began:.0f} s", flush=True)
        seconds[name] = time.perf_counter() - began
        side.close()
    return {f"whole_{k}_s": v for k, v in seconds.items()}


def main() -> None:
    """Measures and prints a table; `--json` keeps the numbers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=256, help="side of the pictures, pixels")
    parser.add_argument("--scenarios", type=int, default=3, help="how many for the handoff table")
    parser.add_argument("--whole", action="store_true", help="also 20 scenarios x 2 trials")
    parser.add_argument("--policy-steps", type=int, default=20, help="observed steps per trial of --whole")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "egl")
    scenarios = list(load_scenarios("libero_starter"))
    picked = [cut(s, PREFIX_STEPS) for s in scenarios[:: max(len(scenarios) // args.scenarios, 1)]]
    numbers = handoffs(picked[: args.scenarios], args.size, later=5)
    numbers["step_ours_bare_ms"] = bare_step_ms(picked[0])
    if args.whole:
        numbers |= whole(scenarios[:20], 2, args.policy_steps, args.size)
    print(table(numbers))
    if args.json:
        args.json.write_text(json.dumps(numbers, indent=2) + "\n")


def table(n: dict) -> str:
    """The numbers as a Markdown table."""
    rows = [
        ("first trial of a scenario, 150-step prefix", n["plain_first"], n["ours_first"], "s"),
        ("later trials", n["plain_later"], n["ours_later"], "s"),
        ("one step, observed", n["step_plain_ms"], n["step_ours_rendered_ms"], "ms"),
        ("one step, nothing rendered", n["step_plain_ms"], n["step_ours_bare_ms"], "ms"),
    ]
    if "whole_plain_s" in n:
        rows.append(("20 scenarios x 2 trials", n["whole_plain_s"], n["whole_ours_s"], "s"))
    lines = ["| | plain | ours | ratio |", "|---|---|---|---|"]
    lines += [f"| {name} | {p:.2f} {u} | {o:.2f} {u} | {p / o:.1f} |" for name, p, o, u in rows]
    lines.append(f"| worker start | | {n['worker_start_s']:.2f} s | |")
    lines.append(f"| memory per worker | | {n['worker_memory_mb']:.0f} MB | |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
