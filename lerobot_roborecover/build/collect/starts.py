"""Initial states to roll out from: which tasks, which seeds or init states, listed or drawn.

A start becomes a scenario whose prefix is nothing but the settling actions, so that slots and engine treat it
as they treat every other; its labels mean nothing.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from lerobot_roborecover.scenario import (
    PLATFORM_ACTION_DIMS,
    DeviationType,
    Reset,
    Scenario,
    ScenarioError,
    Source,
    Stage,
    Task,
)
from lerobot_roborecover.simulators import catalog

LIBERO_SEED = 7
"""Of LIBERO's resets (the paper's release)."""
METAWORLD_HORIZON = 500
"""S of every Meta-World task (`max_path_length` of metaworld 3.0.0)."""
FAKE_HORIZON = 60
MAX_STARTS = 100_000
_MAX_SEED = 2**32 - 1
_NAME_PART = 56
"""Characters of a task's name in an id, before it is cut and a hash takes the rest's place."""


@dataclass(frozen=True)
class Starts:
    """Which initial states of each task."""

    seeds: tuple[int, ...] = ()
    """Of the resets; listed."""
    init_states: tuple[int, ...] = ()
    """LIBERO's stored init states; listed."""
    draw: int = 0
    """So many for each task, drawn instead."""
    seed: int = 7
    """Of the draw."""
    trials: int = 1
    """Rollouts from each start, with random streams of their own."""
    reset_seed: int = LIBERO_SEED
    """Of LIBERO's resets, where the init state is what varies: decides where fixtures stand."""

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

    def resets(self, task: Task) -> list[Reset]:
        """A task's resets, in the order listed or drawn; a longer draw begins with a shorter one.

        Raises:
            ScenarioError: the platform has other starts, or not as many.
        """
        if task.platform == "libero":
            return self._init_states(task)
        if self.init_states:
            raise ScenarioError(
                f"--init-states: {task.platform} has no stored init states; its tasks start from seeds. Use "
                "--seeds or --draw"
            )
        seeds = self.seeds or _distinct(stream(self.seed, "draw", task), self.draw)
        settle = 2 if task.platform == "fake" else 0
        return [Reset(seed=s, settle_steps=settle) for s in seeds]

    def _init_states(self, task: Task) -> list[Reset]:
        from lerobot_roborecover.simulators.libero import SETTLE_STEPS
        from lerobot_roborecover.simulators.libero_init_states import read_init_states

        if self.seeds:
            raise ScenarioError(
                "--seeds: LIBERO's tasks start from stored init states. Use --init-states or --draw; "
                "--reset-seed is the seed of its resets"
            )
        count = len(read_init_states(task.suite, task.name))
        wanted: Sequence[int] = self.init_states
        if self.draw > count:
            raise ScenarioError(f"--draw {self.draw}: {task.suite}/{task.name} has {count} init states")
        if self.draw:
            wanted = stream(self.seed, "draw", task).permutation(count)[: self.draw].tolist()
        missing = [i for i in wanted if i >= count]
        if missing:
            raise ScenarioError(
                f"--init-states: {task.suite}/{task.name} has init states 0 to {count - 1}, not {missing[0]}"
            )
        return [Reset(self.reset_seed, i, SETTLE_STEPS) for i in wanted]


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


def all_tasks(platform: str, robotwin_root: str | None = None) -> list[Task]:
    """Every task of a platform, in its catalogue's order.

    Args:
        platform: its name.
        robotwin_root: RoboTwin's checkout.

    Raises:
        ScenarioError: there is no such platform.
        SimulatorError: its package is not installed.
    """
    if platform == "libero":
        return [
            Task(platform, suite, name, catalog.libero_instruction(name), catalog.LIBERO_HORIZONS[suite])
            for suite, names in catalog.libero_tasks().items()
            for name in names
        ]
    if platform == "metaworld":
        return [
            Task(platform, suite, name, catalog.metaworld_instruction(name), METAWORLD_HORIZON)
            for suite, names in catalog.metaworld_tasks().items()
            for name in names
        ]
    if platform == "fake":
        from lerobot_roborecover.simulators.fake import FAKE_TASKS

        return [
            Task(platform, suite, name, instruction, FAKE_HORIZON)
            for suite, names in FAKE_TASKS.items()
            for name, instruction in names.items()
        ]
    if platform == "robotwin":
        from lerobot_roborecover.simulators.robotwin_checkout import RobotwinCheckout

        checkout = RobotwinCheckout(robotwin_root)
        return [
            # LeRobot's, where the official generator is not asked for (lerobot/envs/robotwin.py)
            Task(platform, suite, name, name.replace("_", " "), horizon)
            for suite in checkout.task_configs
            for name, horizon in checkout.step_limits.items()
        ]
    raise ScenarioError(f"no tasks of platform {platform!r}; there are libero, metaworld and robotwin")


def choose_tasks(tasks: Sequence[Task], patterns: Iterable[str]) -> list[Task]:
    """Tasks that match any of the patterns, in the order of the catalogue.

    Args:
        tasks: of the platform.
        patterns: a suite, a task's name, `suite/name`, each with `*`, `?` and `[...]`.

    Raises:
        ScenarioError: a pattern matches none; names the nearest.
    """
    chosen: set[int] = set()
    for pattern in patterns:
        hits = {
            k
            for k, t in enumerate(tasks)
            if any(fnmatchcase(name, pattern) for name in (t.suite, t.name, f"{t.suite}/{t.name}"))
        }
        if not hits:
            names = (
                {t.suite for t in tasks} | {t.name for t in tasks} | {f"{t.suite}/{t.name}" for t in tasks}
            )
            platform = tasks[0].platform if tasks else "the platform"
            raise ScenarioError(
                f"--task {pattern!r:.120}: no task of {platform}{catalog.nearest(pattern, names)}"
            )
        chosen |= hits
    if not chosen:
        raise ScenarioError("no task: give --task SUITE, --task NAME or --task 'SUITE/PATTERN*'")
    return [t for k, t in enumerate(tasks) if k in chosen]


def make_units(
    tasks: Sequence[Task], starts: Starts, driver: str, settle_action: np.ndarray, *, perturbed: bool
) -> list[Scenario]:
    """One scenario a rollout, task by task.

    Args:
        tasks: where to.
        starts: from where.
        driver: recorded name of whoever drives.
        settle_action: (A,) repeated while settling.
        perturbed: whether actions are perturbed.

    Raises:
        ScenarioError: there are too many, or two have the same id.
    """
    made: dict[str, Scenario] = {}
    for task in tasks:
        for reset in starts.resets(task):
            for trial in range(starts.trials):
                id_ = _id(task, driver, reset, trial if starts.trials > 1 else None, perturbed)
                if id_ in made:
                    raise ScenarioError(f"two rollouts would have the id {id_!r}; collect those tasks apart")
                made[id_] = Scenario(
                    id=id_,
                    task=task,
                    reset=reset,
                    prefix=np.tile(np.asarray(settle_action, np.float64), (reset.settle_steps, 1)),
                    stage=Stage.APPROACH,
                    deviation=DeviationType.WRONG_POSE,
                    source=Source.PERTURBED if perturbed else Source.NATURAL,
                    source_policy=driver,
                    cluster=id_,
                    provenance={"trial": trial, "perturbed": perturbed},
                )
        if len(made) > MAX_STARTS:
            raise ScenarioError(f"more than {MAX_STARTS} rollouts; collect in several folders")
    return list(made.values())


def settle_action(platform: str) -> np.ndarray:
    """(A,) float64 that keeps the robot where it is while the scene settles."""
    if platform == "libero":
        from lerobot_roborecover.simulators.libero import NO_OP

        return NO_OP
    return np.zeros(PLATFORM_ACTION_DIMS[platform][0])


def _id(task: Task, driver: str, reset: Reset, trial: int | None, perturbed: bool) -> str:
    name = f"{task.suite.removeprefix('libero_')}-{task.name}" if task.platform == "libero" else task.name
    start = f"s{reset.seed}" if reset.init_state_index is None else f"i{reset.init_state_index}"
    parts = [_cut(name, _NAME_PART), _cut(driver.split("@")[0], 32), *(["perturbed"] if perturbed else [])]
    return "-".join([*parts, start, *([] if trial is None else [f"t{trial}"])])


def _cut(text: str, longest: int) -> str:
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", text).strip("._-") or "unnamed"
    if len(plain) <= longest and plain == text:
        return plain
    mark = hashlib.sha256(text.encode()).hexdigest()[:6]
    return f"{plain[: longest - 7]}-{mark}" if len(plain) > longest - 7 else f"{plain}-{mark}"
