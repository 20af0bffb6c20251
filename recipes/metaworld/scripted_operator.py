"""A scripted operator at the real teleoperation interface: makes a deviation, stops, marks it, and completes
the task all the same.

    python -m recipes.metaworld.scripted_operator --out OUT --tasks study --seeds 500-505

Starts the server of `curate teleop` and talks to it over its websocket, as the page does. It replaces a
person where none is available, as in a rerun of the study; its recordings name it as controller.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from lerobot_roborecover.platforms.metaworld.experts import expert, patient_expert
from lerobot_roborecover.platforms.simulator import GOAL, HANDLE
from lerobot_roborecover.platforms.starts import parse_numbers
from lerobot_roborecover.web.teleop.client import Client
from lerobot_roborecover.web.teleop.serve import TeleopConfig
from lerobot_roborecover.web.teleop.starts import StartPoint, first_state
from recipes.deviations import DEVIATIONS, Deviation, Fumbled, Hand
from recipes.metaworld.dataset import STUDY_TASKS
from recipes.scripted_operator import FRAME_STRIDE, OPERATOR, Attempt, Stop, Turn, drive
from recipes.scripted_operator import record as record_turns

STOP = Stop(56, 20)
_ATTEMPT_SEEDS = (1, 2)


class Controls(Protocol):
    """What drives: `low_dim()` as a simulator has it, and one action at a time."""

    def low_dim(self) -> np.ndarray:
        """(39,) Meta-World's numbers now."""

    def point(self, name: str) -> np.ndarray:
        """(3,) position of a body or mark, metres."""

    def names(self) -> list[str]:
        """Bodies and marks."""

    def act(self, action: np.ndarray) -> bool:
        """Executes (4,); returns whether the task is solved."""


class Remote:
    """A client as `Controls`, and as the scripted policies' simulator."""

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


class MetaworldHand(Hand):
    """Meta-World's hand, by its numbers.

    Args:
        controls: of the task.
        task: its name.
        rng: of the motions' details.
    """

    gain = 10.0

    def __init__(self, controls: Controls, task: str, rng: np.random.Generator):
        self._controls, self._expert = controls, expert(controls, task)
        super().__init__(rng)

    def at(self) -> np.ndarray:
        """Between the fingertips."""
        return self._controls.point("eef")

    def object(self) -> np.ndarray:
        """The handled point."""
        return self._controls.point(self._handled() + HANDLE)

    def goal(self) -> np.ndarray:
        """Where it belongs."""
        return self._controls.point(GOAL)

    def other(self) -> np.ndarray:
        """The first part that is not to be handled."""
        rest = [
            n for n in self._controls.names() if n not in ("eef", GOAL, self._handled()) and HANDLE not in n
        ]
        if not rest:
            raise Fumbled("the task has one object alone")
        return self._controls.point(rest[0])

    def target(self) -> np.ndarray:
        """The same: what else can move is what the object is brought to."""
        return self.other()

    def over_m(self) -> float:
        """The same for every object."""
        return 0.055

    def carried(self, far_m: float) -> bool:
        """The object is at the hand, and no longer where it was."""
        moved = np.linalg.norm(self.object() - self.start) > far_m
        return bool(moved and np.linalg.norm(self.object() - self.at()) < 0.06)

    def move(self, velocity: np.ndarray, grip: float) -> bool:
        """One action."""
        return self._controls.act(np.clip(np.array([*velocity, grip]), -1.0, 1.0))

    def follow(self, t: int) -> bool:
        """The scripted policy's."""
        return self._controls.act(self._expert(t))

    def _handled(self) -> str:
        return next(n for n in self._controls.names() if n.endswith(HANDLE)).removesuffix(HANDLE)


def attempts(remote: Remote, task: str) -> Iterator[Attempt]:
    """Of the patient scripted policy, each with noise of its own."""
    for seed in _ATTEMPT_SEEDS:
        act = patient_expert(remote, task, np.random.default_rng(seed))
        yield lambda t, act=act: remote.act(act(t))


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
    turns: list[Turn] = []
    for task in tasks:
        for way in ways:
            turns.append(Turn(task, way, range(len(starts), len(starts) + len(seeds))))
            for seed in seeds:
                start = first_state("metaworld", task, seed=seed)
                starts.append(replace(start, task=replace(start.task, horizon=horizon)))
    config = TeleopConfig(
        out, "metaworld", OPERATOR, starts, port=0, rate_hz=1000.0, size=size, frame_stride=FRAME_STRIDE,
        options={"render_quality": "fast"},
    )  # fmt: skip

    def one(client: Client, number: int, how: Deviation, rng: np.random.Generator) -> str:
        task, remote = starts[number].task.name, Remote(client)
        client.start(number, discard=True)
        return drive(client, MetaworldHand(remote, task, rng), how, STOP, attempts(remote, task), horizon)

    return record_turns(config, turns, one)


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
    parser.add_argument(
        "--size", type=int, default=64, help="of the pictures; 0 for none, numbers alone (%(default)s)"
    )
    args = parser.parse_args()
    tasks = STUDY_TASKS if args.tasks == ["study"] else args.tasks
    made = record(args.out, tasks, parse_numbers(args.seeds, "--seeds"), args.ways, args.horizon, args.size)
    print(f"{made.total()} recordings: " + ", ".join(f"{n} {way}" for way, n in made.most_common()))


if __name__ == "__main__":
    main()
