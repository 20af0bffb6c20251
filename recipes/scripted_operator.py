"""What every scripted operator at the real teleoperation interface does, whatever the platform: makes a
deviation, stops, marks it, and completes the task all the same."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.journal import Journal
from lerobot_roborecover.web.background_server import BackgroundServer
from lerobot_roborecover.web.teleop.client import Client, TeleopRefusal
from lerobot_roborecover.web.teleop.serve import TeleopConfig, serve
from lerobot_roborecover.web.teleop.write import recordings_folder
from recipes.deviations import DEVIATIONS, Deviation, Fumbled, Hand

OPERATOR = "scripted-operator"
FRAME_STRIDE = 16
"""Steps from one picture of the dataset to the next: software rendering is slow."""
START_S = 300.0
ATTEMPTS_FILE = "attempts.jsonl"


@dataclass(frozen=True)
class Stop:
    """How an operator stops at a deviation, in steps."""

    steps: int
    """For how long."""
    mark_after: int
    """When it is marked."""


@dataclass(frozen=True)
class Turn:
    """One way into a cell on one task, and the starts on which it is tried until one succeeds."""

    task: str
    way: str
    """Of `DEVIATIONS`."""
    starts: Sequence[int]
    """Numbers of the server's starts."""


type Attempt = Callable[[int], bool]
"""One action towards the task's end, given its number; whether the task is solved."""


def drive(
    client: Client, hand: Hand, how: Deviation, stop: Stop, attempts: Iterable[Attempt], most: int
) -> str:
    """One recording, from where the client has started.

    Args:
        client: at the server.
        hand: that drives through it.
        how: the deviation.
        stop: at the deviation.
        attempts: to complete the task, each from where it stopped.
        most: steps within which the task has to be completed from the mark.

    Returns:
        The recording's id.

    Raises:
        Fumbled: the deviation did not come about, or the task could not be completed from it.
    """
    how.make(hand)
    hand.hold(stop.mark_after, how.grip)
    client.mark(how.stage, how.deviation)
    hand.hold(stop.steps - stop.mark_after, how.grip)
    left, stopped = most - (stop.steps - stop.mark_after), int(client.status["step"])
    for attempt in attempts:
        for t in range(left):
            if attempt(t):
                return client.finish()
        client.back(int(client.status["step"]) - stopped)
    raise Fumbled("the task could not be completed from there")


def record(
    config: TeleopConfig,
    turns: Iterable[Turn],
    one: Callable[[Client, int, Deviation, np.random.Generator], str],
) -> Counter[str]:
    """Records every way into a cell, as far as it can be done. A second call goes on where the first was
    stopped: what each attempt came to is kept beside the recordings, and goes with them.

    Args:
        config: of the server, which is started here and writes the dataset at the end.
        turns: what to record.
        one: makes one recording from a start's number, and returns its id.

    Returns:
        Recordings by way.
    """
    made: Counter[str] = Counter()
    attempts = recordings_folder(config.dataset) / ATTEMPTS_FILE
    with Journal(attempts, 1) as journal, _server(config) as address, Client(address) as client:
        ended = {row["attempt"]: row["recording"] for row in journal.records}
        for turn in turns:
            for number in turn.starts:
                label = f"{turn.task} {turn.way} {_place(config, number)}"
                if label not in ended:
                    rng = np.random.default_rng([number, sum(map(ord, turn.way))])
                    try:
                        ended[label] = why = one(client, number, DEVIATIONS[turn.way], rng)
                    except (Fumbled, TeleopRefusal) as err:
                        ended[label], why = "", str(err)
                    journal.append({"attempt": label, "recording": ended[label]})
                    print(f"{label}: {why}", flush=True)
                if ended[label]:
                    made[turn.way] += 1
                    break
    return made


def _place(config: TeleopConfig, number: int) -> str:
    reset = config.starts[number].reset
    return f"seed {reset.seed}" if reset.init_state_index is None else f"init state {reset.init_state_index}"


@contextmanager
def _server(config: TeleopConfig) -> Iterator[str]:
    """The server's address; interrupted at the end, it writes the dataset."""
    with BackgroundServer("the teleoperation server", serve, config) as server:
        until, line = time.monotonic() + START_S, ""
        while "http://" not in line:
            line = server.hear(until) or ""
            if not line:
                raise ScenarioError("the teleoperation server ended before it gave an address")
        yield line.split()[-1]
        server.interrupt()
        while line := server.hear() or "":
            print(line, flush=True)
