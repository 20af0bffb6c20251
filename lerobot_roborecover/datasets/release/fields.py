"""The fields of a release record: which there are, and what each of them may be."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Any

import numpy as np

from lerobot_roborecover.datasets.release.json_form import texts_of
from lerobot_roborecover.scenario import DeviationType, ScenarioError, Stage

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")
"""Control characters, line separators and what turns the direction of writing."""
_LABELS = re.compile(r"S:([^;]*);D:([^;]*)")


class RequiresOptIn(ScenarioError):
    """A record is refused until the user asks for it by the option that the message names."""


def _integer(value: object) -> str:
    return "" if type(value) is int and 0 <= value < 2**32 else "an integer from 0 to 2^32 - 1"


def _text(value: object) -> str:
    good = isinstance(value, str) and 0 < len(value) <= 2000 and not _CONTROL.search(value)
    return "" if good else "text of 1 to 2000 characters, none of them a control character"


def _truth(value: object) -> str:
    return "" if value is None or isinstance(value, bool) else "true, false or null"


def _one_of(labels: type[StrEnum]) -> Callable[[object], str]:
    wanted = f"one of {', '.join(labels)}"
    return lambda value: "" if value in tuple(labels) else wanted


def _anything(value: object) -> str:
    return ""


def _object(value: object) -> str:
    return "" if isinstance(value, dict) else "an object"


def _state(**widths: int) -> Callable[[object], str]:
    def check(value: object) -> str:
        said = "an object of " + ", ".join(f"{k}[{n}]" if n else k for k, n in widths.items())
        if not isinstance(value, dict) or set(value) != set(widths):
            return said
        for name, width in widths.items():
            numbers = value[name] if width else [value[name]]
            if not isinstance(numbers, list) or len(numbers) != (width or 1):
                return said
            if not all(type(n) in (int, float) and abs(n) < 1e6 for n in numbers):
                return said + " of finite numbers"
            rotation = numbers[-4:] if name == "quat" or name.endswith("_endpose") else [1.0]
            if abs(float(np.linalg.norm(rotation)) - 1.0) > 1e-3:
                norm = np.linalg.norm(rotation)
                return f"{said} with a rotation in {name}: its quaternion has norm {norm:.4g}, not 1"
        return ""

    return check


_COMMON: dict[str, Callable[[object], str]] = {
    "task_description": _text,
    "episode_idx": _integer,
    "seed": _integer,
    "task_suite_name": _text,
    "data_type": _anything,
    "model_name": _anything,
    "s_stage": _one_of(Stage),
    "d_stage": _one_of(DeviationType),
    "annotated_step": _integer,
    "actions": _anything,
}
_FIELDS: dict[str, dict[str, Callable[[object], str]]] = {
    "libero": {
        **_COMMON,
        "model_name": _text,
        "task_id": _integer,
        "error_category": _anything,
        "target_error_category": _anything,
        "initial_state": _state(gripper=0, quat=4, rpy=3, xyz=3),
    },
    "robotwin": {
        **_COMMON,
        "task_name": _text,
        "task_config": _text,
        "instruction": _text,
        "instruction_type": _text,
        "policy_name": _text,
        "success": _truth,
        "total_steps": _integer,
        "initial_state": _state(
            joint_vector=14, left_endpose=7, right_endpose=7, left_gripper=0, right_gripper=0
        ),
        "error_type": _anything,
        "annotation_meta": _object,
    },
}
_OPTIONAL = {"libero": frozenset(), "robotwin": frozenset({"action_type", "video_paths"})}


def check_fields(platform: str, record: Mapping[str, Any], keep_extra: bool) -> None:
    """Checks that a record has its platform's fields, and each of them by itself.

    Raises:
        RequiresOptIn: it has others, and no option keeps them.
        ScenarioError: a field is missing or is not what it must be.
    """
    fields = _FIELDS[platform]
    missing = [name for name in fields if name not in record]
    if missing:
        raise ScenarioError(f"field {missing[0]}: missing; a {platform} record has {', '.join(fields)}")
    extra = [name for name in record if name not in fields and name not in _OPTIONAL[platform]]
    if extra and not keep_extra:
        raise RequiresOptIn(
            f"field {extra[0]!r:.80}: not of the {platform} release format; convert with --keep-extra to "
            "keep such fields in the provenance"
        )
    for name, check in fields.items():
        if wanted := check(record[name]):
            raise ScenarioError(f"field {name}: {record[name]!r:.80} is not {wanted}")
    for name, value in record.items():
        for text in texts_of({name: value}):
            # A note may have several lines.
            if _CONTROL.search(re.sub(r"[\t\n\r]", "", text)):
                raise ScenarioError(f"field {name!r:.80}: {text!r:.80} holds a control character")
    if "total_steps" in fields and record["total_steps"] < record["annotated_step"]:
        raise ScenarioError(
            f"field total_steps: {record['total_steps']}, before the recovery point at annotated_step = "
            f"{record['annotated_step']}"
        )


def check_labels(record: Mapping[str, Any]) -> None:
    """Checks that a record's combined label, such as `S:Approach;D:Wrong Pose`, says what its labels say.

    Raises:
        ScenarioError: names both.
    """
    for name in ("error_category", "error_type"):
        found = _LABELS.fullmatch(str(record.get(name)))
        if found and found.groups() != (record["s_stage"], record["d_stage"]):
            raise ScenarioError(
                f"field {name}: {record[name]!r:.80} contradicts s_stage {record['s_stage']!r} and d_stage "
                f"{record['d_stage']!r}"
            )
