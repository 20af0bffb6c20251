"""Where a person begins: the first state of a task, or some way into a candidate's rollout."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import Reset, Rollout, ScenarioError, Task
from lerobot_roborecover.web.teleop.store import Recorded

MAX_STARTS = 100_000


@dataclass(frozen=True)
class StartPoint:
    task: Task
    reset: Reset
    prefix: np.ndarray
    """(t, A) float64: actions executed before the person takes over; settling at least."""
    source_record: str = ""
    """The candidate whose rollout it continues; empty at a task's first state."""
    origin: Mapping[str, Any] = field(default_factory=dict)
    """Provenance of a continued rollout."""

    @property
    def rollout(self) -> Rollout:
        """What is executed before the person takes over."""
        return Rollout(self.task, self.reset, self.prefix)

    @property
    def label(self) -> str:
        place = f"seed {self.reset.seed}"
        if self.reset.init_state_index is not None:
            place = f"init state {self.reset.init_state_index}"
        more = f", {self.source_record} from step {len(self.prefix)}" if self.source_record else ""
        return f"{self.task.suite} / {self.task.name}, {place}{more}"


def numbers(text: str, option: str) -> list[int]:
    """Numbers from a list like `0-9,12`.

    Raises:
        ScenarioError: it is no such list; names the option.
    """
    found: list[int] = []
    for part in text.split(","):
        first, _, last = (piece.strip() for piece in part.partition("-"))
        if not first.isdecimal() or not (last or first).isdecimal():
            raise ScenarioError(f"{option} {text!r:.80} is not a list of numbers like 0-9,12")
        if max(len(first), len(last)) > len(str(2**32)):
            raise ScenarioError(f"{option} {text!r:.80} names a number beyond 2^32 - 1")
        span = range(int(first), int(last or first) + 1)
        if len(found) + len(span) > MAX_STARTS:
            raise ScenarioError(f"{option} lists more than {MAX_STARTS} numbers")
        found += span
    if not found or max(found) >= 2**32:
        raise ScenarioError(f"{option} {text!r:.80} names no numbers from 0 to 2^32 - 1")
    return list(dict.fromkeys(found))


def first_state(
    platform: str, name: str, suite: str = "", seed: int | None = None, init_state: int | None = None
) -> StartPoint:
    """A task's first state, after its settling.

    Args:
        platform: its simulator.
        name: the platform's own task name.
        suite: where several have a task of this name.
        seed: by default 0, and on LIBERO the paper's 7.
        init_state: LIBERO's; 0 by default.

    Raises:
        ScenarioError: there is no such task, or a number is out of range.
    """
    own = platform_named(platform)
    task = own.task(name, suite=suite)
    reset = own.first_reset(task, seed, init_state)
    return StartPoint(task, reset, np.tile(own.no_op(), (reset.settle_steps, 1)))


def first_states(
    platform: str, names: Sequence[str], suite: str, seeds: str | None, init_states: str | None
) -> list[StartPoint]:
    """Every task from every seed, or on LIBERO from every init state.

    Args:
        platform: its simulator.
        names: task names.
        suite: where several have a task of this name.
        seeds: a list like `0-9,12`, or None for the default.
        init_states: likewise.

    Raises:
        ScenarioError: see `first_state` and `numbers`.
    """
    wanted_seeds: list[int | None] = list(numbers(seeds, "--seeds")) if seeds else [None]
    wanted_states: list[int | None] = list(numbers(init_states, "--init-states")) if init_states else [None]
    return [
        first_state(platform, name, suite, seed, state)
        for name in names
        for seed in wanted_seeds
        for state in wanted_states
    ]


def next_open(starts: Sequence[StartPoint], kept: Iterable[Recorded]) -> int | None:
    """The first start that no recording began from; once all are done, none.

    A session that goes on after another one, or after a crash, need not look for where it was.
    """
    done = {
        (r.task.suite, r.task.name, r.reset.seed, r.reset.init_state_index, r.source_record,
         r.notes.get("driven_from")) for r in kept
    }  # fmt: skip
    for number, start in enumerate(starts):
        task, reset = start.task, start.reset
        key = (
            task.suite,
            task.name,
            reset.seed,
            reset.init_state_index,
            start.source_record,
            len(start.prefix),
        )
        if key not in done:
            return number
    return None


def continued(dataset: Path, candidate: str, step: int) -> StartPoint:
    """Some steps into a candidate's rollout.

    Args:
        dataset: a candidate dataset.
        candidate: its id.
        step: actions to replay before the person takes over.

    Raises:
        ScenarioError: there is no such candidate or step.
    """
    from lerobot_roborecover.curation.candidates import read_candidates

    found = read_candidates(dataset)
    if candidate not in found.by_id:
        raise ScenarioError(f"{dataset} has no candidate {candidate!r:.80}")
    episode = found.by_id[candidate]
    row, reset = found.row(episode), found.row(episode).reset_record()
    if reset is None or not reset.settle_steps <= step <= row.steps:
        first = reset.settle_steps if reset else 0
        raise ScenarioError(f"candidate {candidate} has steps {first} to {row.steps}; got {step}")
    return StartPoint(
        row.task_record(),
        reset,
        found.actions(episode)[:step],
        found.candidates[episode].source_record or candidate,
        {"dataset": found.root.name, "candidate": candidate, "step": step, "driver": row.driver},
    )
