"""Which first states of a task to roll out from: listed or drawn."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.scenario import Reset, ScenarioError, Task
from lerobot_roborecover.utils.options import option

RELEASE_SEED = 7
"""Default seed of resets and draws (the paper's release)."""
MAX_STARTS = 100_000


_MAX_SEED = 2**32 - 1


def parse_numbers(text: str, option: str) -> tuple[int, ...]:
    """Numbers as in `0-29,40`.

    Args:
        text: numbers and ranges, separated by commas.
        option: its name, for the message.

    Raises:
        ScenarioError: it is something else, a number occurs twice, or there are too many.
    """
    found: list[int] = []
    for part in filter(None, (p.strip() for p in text.split(","))):
        match = re.fullmatch(r"(\d{1,10})(?:-(\d{1,10}))?", part)
        low = int(match[1]) if match else 0
        high = int(match[2] or match[1]) if match else -1
        if not low <= high <= _MAX_SEED or high - low >= MAX_STARTS:
            raise ScenarioError(
                f"{option} {text!r:.80}: {part!r:.40} is neither a number from 0 to 2^32 - 1 nor a range "
                f"such as 0-29 of at most {MAX_STARTS}"
            )
        found += range(low, high + 1)
    twice = [n for n in set(found) if found.count(n) > 1] if len(found) != len(set(found)) else []
    if twice or not found:
        raise ScenarioError(f"{option} {text!r:.80}: " + (f"{twice[0]} occurs twice" if twice else "empty"))
    return tuple(found)


def _seeds(text: str) -> tuple[int, ...]:
    return parse_numbers(text, "--seeds") if text else ()


def _init_states(text: str) -> tuple[int, ...]:
    return parse_numbers(text, "--init-states") if text else ()


@dataclass(frozen=True)
class Starts:
    """Which initial states of each task."""

    seeds: tuple[int, ...] = option((), text="", parse=_seeds)
    """Start from these seeds, e.g. 0-29,40.

    Of the resets.
    """
    init_states: tuple[int, ...] = option((), text="", parse=_init_states)
    """Start from these of LIBERO's init states, e.g. 0,3,5-9.

    Of any platform that stores init states.
    """
    draw: int = option(0, metavar="N", text="")
    """Draw N starts of each task instead."""
    seed: int = RELEASE_SEED
    """Seed of every draw: starts, noise, perturbation."""
    reset_seed: int = RELEASE_SEED
    """Reset seed of LIBERO's resets ({default}, the paper's).

    Of resets from stored init states: decides what the init state leaves to chance.
    """
    trials: int = 1
    """Rollouts from each start.

    With random streams of their own.
    """

    def __post_init__(self):
        given = [n for n in ("seeds", "init_states", "draw") if getattr(self, n)]
        if len(given) != 1:
            said = "none of them was given" if not given else f"{' and '.join(given)} were given"
            raise ScenarioError(
                f"starts: {said}. Give one: listed (--seeds 0-29, or --init-states 0,3,5 on LIBERO) or "
                "drawn (--draw 20)"
            )
        if not 1 <= self.trials <= 1000 or not 0 <= self.draw <= MAX_STARTS:
            raise ScenarioError(
                f"--trials {self.trials} and --draw {self.draw}: 1 to 1000, and to {MAX_STARTS}"
            )

    def by_seed(self, task: Task, settle_steps: int = 0) -> list[Reset]:
        """Resets of a task that a seed lays out; a longer draw begins with a shorter one.

        Args:
            task: whose.
            settle_steps: leading actions that only let the scene settle.

        Raises:
            ScenarioError: init states were asked for.
        """
        if self.init_states:
            raise ScenarioError(
                f"--init-states: {task.platform} has no stored init states; its tasks start from seeds. Use "
                "--seeds or --draw"
            )
        seeds = self.seeds or _distinct(stream(self.seed, "draw", task), self.draw)
        return [Reset(seed=s, settle_steps=settle_steps) for s in seeds]

    def by_init_state(self, task: Task, count: int, settle_steps: int) -> list[Reset]:
        """Resets of a task that starts from stored init states.

        Args:
            task: whose.
            count: how many init states it has.
            settle_steps: leading actions that only let the scene settle.

        Raises:
            ScenarioError: seeds were asked for, or more init states than there are.
        """
        if self.seeds:
            raise ScenarioError(
                f"--seeds: tasks of {task.platform} start from stored init states. Use --init-states or "
                "--draw; --reset-seed is the seed of their resets"
            )
        if self.draw > count:
            raise ScenarioError(f"--draw {self.draw}: {task.suite}/{task.name} has {count} init states")
        wanted = list(self.init_states)
        if self.draw:
            wanted = stream(self.seed, "draw", task).permutation(count)[: self.draw].tolist()
        missing = [i for i in wanted if i >= count]
        if missing:
            raise ScenarioError(
                f"--init-states: {task.suite}/{task.name} has init states 0 to {count - 1}, not {missing[0]}"
            )
        return [Reset(self.reset_seed, i, settle_steps) for i in wanted]


def stream(
    seed: int, purpose: str, task: Task, reset: Reset | None = None, trial: int = 0
) -> np.random.Generator:
    """The random stream of one purpose of one rollout: from its seed, task, start and trial alone, so that it
    does not depend on order, slots or resumption."""
    start = (None, None) if reset is None else (reset.seed, reset.init_state_index)
    key = [purpose, task.platform, task.suite, task.name, *start, trial]
    words = np.frombuffer(hashlib.sha256(json.dumps(key).encode()).digest(), "<u4")
    return np.random.default_rng([seed, *words.tolist()])


def _distinct(rng: np.random.Generator, count: int) -> list[int]:
    found: dict[int, None] = {}
    while len(found) < count:
        found.setdefault(int(rng.integers(0, 2**31)))
    return list(found)
