"""A scripted operator at the real teleoperation interface: makes a deviation, stops, marks it, and completes
the task all the same.

    python -m recipes.metaworld.scripted_operator --out OUT --tasks study --seeds 500-505

Starts `roborecover teleop`'s server and talks to it over its websocket, as the page does. It stands in for a
person where nobody can be asked, such as in the study that anyone re-runs; its recordings name it as driver.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from lerobot_roborecover.curation.collect.starts import parse_numbers
from lerobot_roborecover.platforms.metaworld.experts import expert, patient_expert
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.studio.line_process import LineProcess
from lerobot_roborecover.studio.teleop.client import Client, TeleopRefusal
from lerobot_roborecover.studio.teleop.serve import TeleopConfig, serve
from lerobot_roborecover.studio.teleop.starts import StartPoint, first_state
from recipes.metaworld.dataset import STUDY_TASKS
from recipes.metaworld.deviations import DEVIATIONS, Deviation, Fumbled, Hand

OPERATOR = "scripted-operator"
STOP_STEPS, MARK_AFTER = 56, 20
"""How long it stops once the deviation is there, and when it marks it."""
FILM_EVERY = 16
"""Steps from one picture of the dataset to the next: software rendering is slow."""
START_S = 300.0
_ATTEMPT_SEEDS = (1, 2)


class Remote:
    """A client as `metaworld_deviations.Controls`, and as the scripted policies' simulator."""

    def __init__(self, client: Client):
        self.client = client

    def low_dim(self) -> np.ndarray:
        """(39,) Meta-World's numbers now."""
        return np.array(self.client.state["low_dim"], dtype=np.float64)

    def point(self, name: str) -> np.ndarray:
        """(3,) position of a body or mark."""
        return np.array(self.client.state["bodies"][name][:3], dtype=np.float64)

    def names(self) -> list[str]:
        """Bodies and marks."""
        return list(self.client.state["bodies"])

    def act(self, action: np.ndarray) -> bool:
        """One action; whether the task is solved."""
        return bool(self.client.act(np.clip(action, -1.0, 1.0))["solved"])


def drive(client: Client, number: int, task: str, how: Deviation, rng: np.random.Generator, most: int) -> str:
    """One recording.

    Args:
        client: at the server.
        number: of the start.
        task: its name.
        how: the deviation.
        rng: of its details.
        most: steps within which the task has to be completed from the mark.

    Returns:
        The recording's id.

    Raises:
        Fumbled: the deviation did not come about, or the task could not be completed from it.
    """
    remote = Remote(client)
    client.start(number, discard=True)
    hand = Hand(remote, expert(remote, task), rng)
    how.make(hand)
    hand.hold(MARK_AFTER, how.grip)
    client.mark(how.stage, how.deviation)
    hand.hold(STOP_STEPS - MARK_AFTER, how.grip)
    left, stopped = most - (STOP_STEPS - MARK_AFTER), int(client.status["step"])
    for seed in _ATTEMPT_SEEDS:
        act = patient_expert(remote, task, np.random.default_rng(seed))
        for t in range(left):
            if remote.act(act(t)):
                return client.finish()
        client.back(int(client.status["step"]) - stopped)
    raise Fumbled("the task could not be completed from there")


def record(
    out: Path, tasks: Sequence[str], seeds: Sequence[int], ways: Sequence[str], horizon: int, size: int
) -> Counter[str]:
    """Records every way into a cell on every task and seed, as far as it can be done.

    Args:
        out: candidate dataset.
        tasks: names.
        seeds: of each way and task, in turn: each is tried until one succeeds.
        ways: of `DEVIATIONS`.
        horizon: budget of the tasks.
        size: of the dataset's pictures.

    Returns:
        Recordings by way.
    """
    starts: list[StartPoint] = []
    plan: list[tuple[str, str, list[int]]] = []
    for task in tasks:
        for way in ways:
            first = len(starts)
            for seed in seeds:
                start = first_state("metaworld", task, seed=seed)
                starts.append(replace(start, task=replace(start.task, horizon=horizon)))
            plan.append((task, way, list(range(first, len(starts)))))
    config = TeleopConfig(
        out, "metaworld", OPERATOR, starts, port=0, rate_hz=1000.0, size=size, film_every=FILM_EVERY,
        options={"render_quality": "fast"},
    )  # fmt: skip
    made: Counter[str] = Counter()
    with _server(config) as address, Client(address) as client:
        for task, way, numbers in plan:
            for number in numbers:
                rng = np.random.default_rng([number, sum(map(ord, way))])
                try:
                    name = drive(client, number, task, DEVIATIONS[way], rng, horizon)
                except (Fumbled, TeleopRefusal) as err:
                    print(f"{task} {way} seed {starts[number].reset.seed}: {err}", flush=True)
                    continue
                made[way] += 1
                print(f"{task} {way} seed {starts[number].reset.seed}: {name}", flush=True)
                break
    return made


@contextmanager
def _server(config: TeleopConfig) -> Iterator[str]:
    """The server's address; interrupted at the end, it writes the dataset."""
    with LineProcess("the teleoperation server", serve, config) as server:
        until, line = time.monotonic() + START_S, ""
        while "http://" not in line:
            line = server.hear(until) or ""
            if not line:
                raise ScenarioError("the teleoperation server ended before it gave an address")
        yield line.split()[-1]
        server.interrupt()
        while line := server.hear() or "":
            print(line, flush=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the candidate dataset")
    parser.add_argument("--tasks", nargs="+", default=["study"], help="names, or `study`: its sixteen")
    parser.add_argument("--seeds", default="500-502", help="tried in turn until one succeeds (%(default)s)")
    parser.add_argument("--ways", nargs="+", choices=DEVIATIONS, default=list(DEVIATIONS), metavar="WAY")
    parser.add_argument("--horizon", type=int, default=200, help="budget of the tasks (%(default)s)")
    parser.add_argument("--size", type=int, default=64, help="of the pictures (%(default)s)")
    args = parser.parse_args()
    tasks = STUDY_TASKS if args.tasks == ["study"] else args.tasks
    made = record(args.out, tasks, parse_numbers(args.seeds, "--seeds"), args.ways, args.horizon, args.size)
    print(f"{made.total()} recordings: " + ", ".join(f"{n} {way}" for way, n in made.most_common()))


if __name__ == "__main__":
    main()
