"""How many observed steps a second the engine carries: fake simulators that cost nothing, two pictures each.

    python benchmarks/observed_steps.py                # through shared memory and through pipes, in turns
    python benchmarks/observed_steps.py --slots 4 --size 128

Every step is looked at: one action an inference, and an observation of two pictures of 256 x 256 after each.
The policy costs nothing. What is left is the engine and the way of the pictures. Wall time follows whatever
else the machine does; CPU milliseconds of a step, over this process and the simulators, do not, and two cores
carry 2,000 / (CPU ms) steps a second where nothing else runs.
"""

from __future__ import annotations

import argparse
import hashlib
import statistics
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parent))

from engine_parts import StubHost, run_engine

from lerobot_roborecover.workers import slots as slots_module
from lerobot_roborecover.workers.messages import ActResult, EpisodeStart, SlotConfig, make_memory
from lerobot_roborecover.workers.worker import SlotServer
from tests.support.factories import fake_scenario

WAYS = {True: "memory", False: "pipes"}


class PictureServer(SlotServer):
    """The fake simulator's slot, with two pictures in every observation, which follow from state and step
    alone: whichever slot has a trial, it shows the same."""

    def __init__(self, config: SlotConfig):
        super().__init__(config)
        size = config.settings["size"]
        self._step = 0
        self._pictures = np.random.default_rng(0).integers(0, 256, (2, size, size, 3), dtype=np.uint8)

    def answer(self, command: str, argument: Any = None) -> Any:
        """The usual answer, and pictures."""
        reply = super().answer(command, argument)
        if isinstance(reply, EpisodeStart | ActResult) and reply.observation is not None:
            self._step = 0 if isinstance(reply, EpisodeStart) else self._step + 1
            shown = hashlib.sha256(reply.observation["agent_pos"].tobytes() + self._step.to_bytes(4)).digest()
            self._pictures[:, 0, :8, 0] = np.frombuffer(shown, np.uint8)[:8]
            pictures = {"image": self._pictures[0], "image2": self._pictures[1]}
            return replace(reply, observation={**reply.observation, "pixels": pictures})
        return reply


class LookingHost(StubHost):
    """Keeps a hash of all that it was shown, if asked to."""

    max_batch = 256

    def __init__(self, width: int, hashed: bool):
        super().__init__(width, chunk=1)
        self._hashed = hashed
        self.seen: list[str] = []

    def act(self, observations: list, instructions: list[str], histories: list) -> list[np.ndarray]:
        """One action for everyone."""
        if self._hashed:
            for one in observations:
                pictures = b"".join(one["pixels"][key].tobytes() for key in sorted(one["pixels"]))
                self.seen.append(hashlib.sha256(one["agent_pos"].tobytes() + pictures).hexdigest())
        return super().act(observations, instructions, histories)


def measure(memory: bool, args: argparse.Namespace, hashed: bool = False) -> dict[str, Any]:
    """One run; rates, and what the policy saw."""
    scenarios = [replace(fake_scenario(k, horizon=args.steps), fingerprint=None) for k in range(args.slots)]
    host, spent = LookingHost(2, hashed), []
    config = SlotConfig("fake", server="observed_steps:PictureServer", settings={"size": args.size})
    with mock.patch.object(slots_module, "make_memory", make_memory if memory else lambda: None):
        seconds, rows = run_engine(
            scenarios, config, host, slots=args.slots, trials=args.trials, spent=spent.append
        )
    steps, (own, simulators, _) = sum(rows), spent[0]
    return {
        "steps": steps, "rate": steps / seconds, "own_ms": 1e3 * own / steps,
        "simulators_ms": 1e3 * simulators / steps, "seen": sorted(host.seen),
    }  # fmt: skip


def main() -> None:
    """Prints a line a run, and the medians."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--slots", type=int, default=2)
    parser.add_argument("--size", type=int, default=256, help="of a picture, pixels")
    parser.add_argument("--steps", type=int, default=200, help="of a trial, at most")
    parser.add_argument("--trials", type=int, default=5, help="of each slot's scenario")
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    found: dict[bool, list] = {True: [], False: []}
    for _ in range(args.repeat):
        for memory in (True, False):
            run = measure(memory, args)
            found[memory].append(run)
            print(
                f"{WAYS[memory]:6}  {run['steps']} steps, {run['rate']:.0f}/s, CPU ms a step: "
                f"engine {run['own_ms']:.3f}, simulators {run['simulators_ms']:.3f}",
                flush=True,
            )
    for memory, runs in found.items():
        cpu = statistics.median(r["own_ms"] + r["simulators_ms"] for r in runs)
        print(
            f"{WAYS[memory]}: median {statistics.median(r['rate'] for r in runs):.0f} steps/s, "
            f"{cpu:.3f} CPU ms a step, which two cores carry {2e3 / cpu:.0f} times a second"
        )


if __name__ == "__main__":
    main()
