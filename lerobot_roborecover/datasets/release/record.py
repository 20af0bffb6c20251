"""One scenario file of the release, as a `Scenario` and back.

Every field is kept: what has a place in a scenario goes there, and the whole record without its actions goes
to the provenance, so that `to_json` gives the file back byte for byte.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from lerobot_roborecover.datasets.release.fields import RequiresOptIn, check_fields
from lerobot_roborecover.datasets.release.json_form import KEY, form_of, parse_json
from lerobot_roborecover.datasets.release.sources import Sources
from lerobot_roborecover.platforms.libero.catalog import LIBERO_HORIZONS, libero_instruction, libero_tasks
from lerobot_roborecover.platforms.libero.init_states import leading_no_ops, read_init_states
from lerobot_roborecover.platforms.robotwin.platform import ACTION_DIMS, STEP_LIMITS
from lerobot_roborecover.rollout import MAX_ACTION_MAGNITUDE, MAX_PREFIX_STEPS
from lerobot_roborecover.scenario import Reset, Scenario, ScenarioError, Task

LIBERO_SEED = 7
"""The release resets every LIBERO scenario with `env.seed(7)`."""


@dataclass(frozen=True)
class Reading:
    """How records are read."""

    sources: Sources = field(default_factory=Sources)
    """Rules and exceptions that tell natural, perturbed and human scenarios apart."""
    keep_extra: bool = False
    """Keep fields that the format does not name in the provenance, instead of refusing their records."""
    any_seed: bool = False
    """Take LIBERO records whose seed is not the release's, each with its own."""


RULES = Reading()
"""Nothing but what the format says, without exceptions."""


def look(data: bytes) -> tuple[str, str, int, tuple[str, str]]:
    """What a split table would say of a file, from the record alone; `to_scenario` checks it.

    Returns:
        Platform, task name, number of actions, stage and deviation type.

    Raises:
        ScenarioError: it is no record of the release.
    """
    record = parse_json(data)
    actions = record.get("actions")
    count = len(actions) if isinstance(actions, list) else 0
    labels = str(record.get("s_stage")), str(record.get("d_stage"))
    if "task_id" in record:
        return "libero", f"{record.get('task_suite_name')}/{record['task_id']}", count, labels
    if "task_config" in record:
        return "robotwin", str(record.get("task_name")), count, labels
    raise ScenarioError(
        "neither a LIBERO record, which has a field task_id, nor a RoboTwin record, which has task_config; "
        f"its fields are {', '.join(record)!s:.200}"
    )


def check_seed(seed: int | None, reading: Reading) -> None:
    """Checks that a LIBERO reset has the release's seed.

    Raises:
        RequiresOptIn: it has another seed, and `reading` does not allow that.
    """
    if seed != LIBERO_SEED and not reading.any_seed:
        raise RequiresOptIn(
            f"field seed: {seed}; the release resets every LIBERO scenario with env.seed({LIBERO_SEED}). "
            "Another seed puts fixtures millimetres to centimetres elsewhere, which no field of a record "
            "would show. To take such records with their own seeds: --any-seed"
        )


def to_scenario(
    platform: str,
    data: bytes,
    *,
    split: str,
    sample_id: str,
    prefix_steps: int,
    reading: Reading,
) -> Scenario:
    """Reads one record.

    Args:
        platform: `libero` or `robotwin`.
        data: the file's bytes.
        split: `train` or `test`.
        sample_id: the scenario's id.
        prefix_steps: how many of the record's actions lead to the recovery point.
        reading: what is taken.

    Raises:
        ScenarioError: names the field, the value and what it may be; what to do about it depends on where
            the file is from, which its reader knows.
    """
    record = parse_json(data)
    check_fields(platform, record, reading.keep_extra)
    if platform == "libero":
        check_seed(record["seed"], reading)
    actions, integers = _actions(record["actions"])
    _check_prefix(record["annotated_step"], len(actions), prefix_steps)
    note: dict[str, Any] = {"record": {**record, "actions": None}, "json": form_of(data, record)}
    if integers:
        note["integers"] = integers
    if prefix_steps < len(actions):
        note["tail"] = actions[prefix_steps:].tolist()
    prefix = actions[:prefix_steps]
    too_large = np.argwhere(np.abs(prefix) > MAX_ACTION_MAGNITUDE)
    if len(too_large):
        i, j = too_large[0]
        raise ScenarioError(
            f"field actions[{i}][{j}]: {prefix[i, j]:g}; of a magnitude the limit is {MAX_ACTION_MAGNITUDE:g}"
        )
    make = _libero if platform == "libero" else _robotwin
    task, reset, driver, cluster = make(record, prefix)
    source, policy = reading.sources.of(driver)
    return Scenario(
        id=sample_id,
        task=task,
        reset=reset,
        prefix=prefix,
        stage=record["s_stage"],
        deviation=record["d_stage"],
        source=source,
        source_policy=policy,
        split=split,
        cluster=cluster,
        provenance={KEY: note},
    )


def _actions(value: object) -> tuple[np.ndarray, str]:
    """The actions, (N, A) float64, and in hex one bit a number: it was written as an integer."""
    if not isinstance(value, list) or not value or not all(isinstance(row, list) for row in value):
        raise ScenarioError(f"field actions: {value!r:.80} is not a list of actions, each a list of numbers")
    if len(value) > MAX_PREFIX_STEPS:
        raise ScenarioError(f"field actions: {len(value)} actions; the limit is {MAX_PREFIX_STEPS}")
    width = len(value[0])
    kinds = set()
    for i, row in enumerate(value):
        if len(row) != width:
            raise ScenarioError(
                f"field actions[{i}]: {len(row)} numbers, actions[0] has {width}; all have the same"
            )
        kinds.update(map(type, row))
    if not kinds <= {int, float}:
        i, j, bad = next(
            (i, j, v) for i, row in enumerate(value) for j, v in enumerate(row) if type(v) not in (int, float)
        )
        raise ScenarioError(f"field actions[{i}][{j}]: {bad!r:.80} is not a number")
    try:
        actions = np.array(value, dtype=np.float64)
    except OverflowError:
        raise ScenarioError("field actions: an integer is too large for a float64") from None
    if int not in kinds:
        return actions, ""
    flags = np.array([[type(v) is int for v in row] for row in value])
    return actions, np.packbits(flags.ravel()).tobytes().hex()


def _check_prefix(annotated_step: int, actions: int, prefix_steps: int) -> None:
    if prefix_steps > actions:
        raise ScenarioError(
            f"field actions: {actions} actions, fewer than the replay_prefix_steps = {prefix_steps} of the "
            "split table; a prefix is never padded"
        )
    # A record keeps the frame of the annotation or the action after it, so that both counts occur.
    if prefix_steps not in (annotated_step, annotated_step + 1):
        raise ScenarioError(
            f"field annotated_step: {annotated_step}, but {prefix_steps} actions are replayed (column "
            "replay_prefix_steps; without a split table, all of them); the two conventions of the release "
            "are annotated_step and annotated_step + 1"
        )


def _libero(record: Mapping[str, Any], prefix: np.ndarray) -> tuple[Task, Reset, str, str]:
    suite, number = record["task_suite_name"], record["task_id"]
    suites = libero_tasks()
    if suite not in suites:
        raise ScenarioError(f"field task_suite_name: {suite!r:.80} is not one of {', '.join(suites)}")
    if number >= len(suites[suite]):
        raise ScenarioError(f"field task_id: {number}; {suite} has tasks 0 to {len(suites[suite]) - 1}")
    _check_width(prefix, (7,), "a LIBERO action")
    name = suites[suite][number]
    states = _init_states(suite, name)
    if record["episode_idx"] >= states:
        raise ScenarioError(
            f"field episode_idx: {record['episode_idx']}; task {number} of {suite} has init states 0 to "
            f"{states - 1}"
        )
    # The paper's evaluators prompt with LIBERO's `task.language`; `task_description` often has other words.
    return (
        Task("libero", suite, name, libero_instruction(name), LIBERO_HORIZONS[suite]),
        Reset(
            seed=record["seed"],
            init_state_index=record["episode_idx"],
            settle_steps=leading_no_ops(prefix),
        ),
        record["model_name"],
        f"{record['model_name']}:{suite}/{number}:{record['seed']}:{record['episode_idx']}",
    )


@cache
def _init_states(suite: str, name: str) -> int:
    """Returns how many init states LIBERO stores for a task."""
    return len(read_init_states(suite, name))


def _robotwin(record: Mapping[str, Any], prefix: np.ndarray) -> tuple[Task, Reset, str, str]:
    name = record["task_name"]
    if name not in STEP_LIMITS:
        raise ScenarioError(
            f"field task_name: {name!r:.80} is not one of RoboTwin's {len(STEP_LIMITS)} tasks"
        )
    kind = record.get("action_type", "qpos")
    if not isinstance(kind, str) or kind not in ACTION_DIMS:
        raise ScenarioError(f"field action_type: {kind!r:.80} is not one of {', '.join(ACTION_DIMS)}")
    _check_width(prefix, (ACTION_DIMS[kind],), f"a RoboTwin action of type {kind}")
    return (
        Task("robotwin", record["task_config"], name, record["instruction"], STEP_LIMITS[name]),
        Reset(seed=record["seed"]),
        record["policy_name"],
        # The paper resamples RoboTwin by this: scenarios of two policies in one scene share it.
        f"{name}:{record['seed']}:{record['episode_idx']}",
    )


def _check_width(prefix: np.ndarray, widths: tuple[int, ...], what: str) -> None:
    if prefix.shape[1] not in widths:
        raise ScenarioError(
            f"field actions: width {prefix.shape[1]}; {what} has {' or '.join(map(str, widths))} numbers"
        )
