"""Which frames a monitor is trained and measured on, chosen before anything is rendered.

Label 0 strictly before the recovery point, 1 from it on; whole scenarios to training or validation (paper,
appendix, "Monitor Training and Triggering").
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lerobot_roborecover.curation.continuations import Continuation
from lerobot_roborecover.datasets.trajectory_write import split_by_scenario
from lerobot_roborecover.errors import check_seed
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.options import option

TRAIN, BALANCED, NATURAL = "train", "validation_balanced", "validation_natural"
PARTS = (TRAIN, BALANCED, NATURAL)


@dataclass(frozen=True)
class DataOptions:
    """How frames are chosen."""

    validation: float = 0.1
    """Held-out share or number; 1: all.

    Of scenarios (paper: 80 of 800 on RoboTwin). 1 makes no training part, e.g. to measure on a test split.
    """
    split_by: Literal["scenario", "cluster"] = "scenario"
    """What is held out whole; a cluster is the scenarios of one source trajectory."""
    train_balanced: bool = option(True, name="natural-training")
    """Do not balance the labels of the training part.

    Balanced in the paper on RoboTwin, natural on LIBERO.
    """
    train_frames: int | None = None
    """Frames of the training part (all that balance allows)."""
    balanced_frames: int | None = None
    """Frames of the balanced validation (all that balance allows)."""
    natural_frames: int | None = None
    """Frames of the natural validation (every one).

    Delays in steps are exact for every one.
    """
    every: int = option(1, name="stride", metavar="N", old=("every",))
    """Choose among every N-th step only.

    Counted from the recovery point both ways.
    """
    seed: int = 0
    """Seed of the split and the choice of frames."""

    def __post_init__(self):
        check_seed(self.seed)
        if self.split_by not in ("scenario", "cluster"):
            raise ScenarioError(f"split by {self.split_by!r}: must be scenario or cluster")
        if self.every < 1 or self.validation <= 0:
            raise ScenarioError(f"every={self.every} and validation={self.validation} must be above 0")
        for name in ("train_frames", "balanced_frames", "natural_frames"):
            value = getattr(self, name)
            if value is not None and value < 2:
                raise ScenarioError(f"{name}={value}: must be at least 2, one of each label")


@dataclass(frozen=True)
class Chosen:
    """A trajectory's chosen frames."""

    continuation: Continuation
    steps: np.ndarray
    """(k,) int64, increasing."""

    @property
    def labels(self) -> list[int]:
        """0 or 1 per chosen frame."""
        return [int(s >= self.continuation.recovery_step) for s in self.steps]


def choose(continuations: Sequence[Continuation], options: DataOptions) -> dict[str, list[Chosen]]:
    """Splits by scenario and chooses each part's frames.

    Raises:
        ScenarioError: too few scenarios, or fewer frames than asked for.
    """
    split = split_scenarios([c.scenario for c in continuations], options)
    train = [c for c in continuations if split[c.scenario.id] == "train"]
    held_out = [c for c in continuations if split[c.scenario.id] == "validation"]
    rng = np.random.default_rng([options.seed, 1])
    parts = {}
    if train:
        parts[TRAIN] = _draw(train, options.train_frames, options.train_balanced, options.every, rng, TRAIN)
    return parts | {
        BALANCED: _draw(held_out, options.balanced_frames, True, options.every, rng, BALANCED),
        NATURAL: _draw(held_out, options.natural_frames, False, options.every, rng, NATURAL),
    }


def split_scenarios(scenarios: Iterable[Scenario], options: DataOptions) -> dict[str, str]:
    """`train` or `validation` by scenario id.

    Raises:
        ScenarioError: nothing is left for one of the two.
    """
    by_cluster = options.split_by == "cluster"
    unit = {s.id: (s.cluster or s.id) if by_cluster else s.id for s in scenarios}
    count = len(set(unit.values()))
    share = options.validation <= 1
    held_out = max(round(count * options.validation), 1) if share else int(options.validation)
    if held_out > count or (held_out == count and options.validation != 1):
        raise ScenarioError(
            f"{held_out} of {count} {options.split_by}s for validation leave none for training. Give more "
            "scenarios, or a smaller --validation"
        )
    sizes = {"train": count - held_out, "validation": held_out}
    assigned = split_by_scenario(unit.values(), sizes, np.random.default_rng([options.seed, 0]))
    return {name: assigned[u] for name, u in unit.items()}


def _draw(
    continuations: Sequence[Continuation],
    frames: int | None,
    balanced: bool,
    every: int,
    rng: np.random.Generator,
    part: str,
) -> list[Chosen]:
    """Chooses frames without replacement, each as likely as any other of its label (or of all)."""
    table = []
    for number, c in enumerate(continuations):
        steps = np.arange(c.recovery_step % every, c.recovery_step + len(c.actions), every)
        table.append(np.stack([np.full(len(steps), number), steps, steps >= c.recovery_step], axis=1))
    pool = np.concatenate(table).astype(np.int64)
    counts = [int((pool[:, 2] == label).sum()) for label in (0, 1)]
    if not min(counts):
        raise ScenarioError(f"{part}: there are {counts[0]} frames of label 0 and {counts[1]} of label 1")
    most = 2 * min(counts) if balanced else sum(counts)
    wanted = most if frames is None else frames
    if wanted > most:
        raise ScenarioError(
            f"{part}: {wanted} frames are asked for; {counts[0]} of label 0 and {counts[1]} of label 1 allow "
            f"{most}. Ask for fewer, or give more policies or scenarios"
        )
    if balanced:
        groups = [np.flatnonzero(pool[:, 2] == label) for label in (0, 1)]
        taken = np.concatenate([rng.choice(g, wanted // 2, replace=False) for g in groups])
    else:
        taken = np.arange(len(pool)) if wanted == most else rng.choice(len(pool), wanted, replace=False)
    rows = pool[np.sort(taken)]
    return [
        Chosen(c, rows[rows[:, 0] == number, 1])
        for number, c in enumerate(continuations)
        if (rows[:, 0] == number).any()
    ]


def count(chosen: Sequence[Chosen]) -> dict[str, int]:
    """IDs, trajectories, frames and labels of a part."""
    labels = Counter(label for c in chosen for label in c.labels)
    return {
        "ids": len({c.continuation.scenario.id for c in chosen}),
        "trajectories": len(chosen),
        "frames": labels.total(),
        "label0": labels[0],
        "label1": labels[1],
    }
