"""The fields of a trial log's row: limits, and a check for each.

The limits are those of what can be run: names as the scenario format has them, steps within the horizon.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from datetime import datetime
from enum import StrEnum
from typing import Any

from lerobot_roborecover.logs.robot import problem_of as robot_problem
from lerobot_roborecover.scenario import DeviationType, Outcome, Source, Stage, Start

TRIAL_SCHEMA = 4
"""1: rows without `progress`. 2: rows without `first_state`, `policy_settings`, `run_scenarios`, `run_trials`
and `shard`. 3: rows without `robot`. All are read as rows that say nothing of these."""
MAX_LINE_BYTES = 2**24
"""Longest line of a log; a row has about 1.5 kB."""
MAX_STEPS = 100_000
"""Largest horizon of a task, and longest way a scenario replays or goes back."""
MAX_TRIALS = 1_000_000
MAX_SECONDS = 1e9
_MAX_NAME = 256
_MAX_LONG_NAME = 4096
MAX_TEXT = 100_000
_MAX_DEPTH = 8
"""Levels of lists and objects in `options` and `interventions`."""
_SEEDS = (-(2**63), 2**64 - 1)
REMEDY = "Correct the line, or remove it to run its trial again"

UNKNOWN_WEIGHTS = "server_weights"
"""The setting that says that nothing is known of a server's weights."""
OBJECT = "policy"
"""The setting that holds a policy's identity where the user gave it another name."""
CALLABLE = "callable"
"""Policy type of a Python callable."""
_VOUCHED = (OBJECT, UNKNOWN_WEIGHTS, "server", "device")
"""Settings that may differ between the runs of one method."""


class FieldProblem(ValueError):
    """A record is no trial row; the message names the field, the value and the limit."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split("\n")))


def shown(value: object) -> str:
    """A value for a message, cut where it is long."""
    try:
        text = repr(value)
    except RecursionError:
        text = f"a deeply nested {type(value).__name__}"
    return text if len(text) <= 80 else f"{text[:79]}…"


def refused(field: str, value: object, rule: str) -> FieldProblem:
    """The problem of a field whose value breaks a rule."""
    return FieldProblem(f"field {field!r}: {field} is {shown(value)}, {rule}. {REMEDY}")


def _name(limit: int, *, empty: bool, none: bool = False) -> Callable[[str, Any], None]:
    def check(field: str, value: Any) -> None:
        if none and value is None:
            return
        if not isinstance(value, str):
            raise refused(field, value, "not text")
        if len(value) > limit or not value.isprintable() or not (value or empty):
            least = 0 if empty else 1
            raise refused(field, value, f"not {least} to {limit} printable characters")

    return check


def _text(field: str, value: Any) -> None:
    if not isinstance(value, str):
        raise refused(field, value, "not text")
    if len(value) > MAX_TEXT:
        raise refused(field, value, f"with {len(value)} characters; the limit is {MAX_TEXT}")
    try:
        value.encode()
    except UnicodeEncodeError:  # JSON's escapes can smuggle halves of characters in
        raise refused(
            field, value, "with half a character (a lone surrogate), which is no Unicode text"
        ) from None


def _member(enum: type[StrEnum]) -> Callable[[str, Any], None]:
    known = [str(member) for member in enum]

    def check(field: str, value: Any) -> None:
        if not isinstance(value, str) or value not in known:
            raise FieldProblem(f"field {field!r}: {field} {shown(value)} is not one of {known}. {REMEDY}")

    return check


def _sha256(field: str, value: Any) -> None:
    if not isinstance(value, str) or len(value) != 64 or set(value) - set("0123456789abcdef"):
        raise refused(field, value, "not a SHA-256 of 64 hexadecimal digits")


def _sha256_or_empty(field: str, value: Any) -> None:
    if value != "":
        _sha256(field, value)


def _optional_size(field: str, value: Any) -> None:
    if value is not None and (type(value) is not int or not 1 <= value <= MAX_TRIALS):
        raise refused(field, value, f"neither null nor a count from 1 to {MAX_TRIALS}")


def _shard(field: str, value: Any) -> None:
    if value == "":
        return
    k, _, n = value.partition("/") if isinstance(value, str) else ("", "", "")
    good = all(part.isascii() and part.isdigit() and len(part) <= 7 for part in (k, n))
    if not good or not int(k) < int(n):
        raise refused(field, value, "neither empty nor k/n with k from 0 to n - 1")


def _moment(field: str, value: Any) -> None:
    if not isinstance(value, str):
        raise refused(field, value, "not text")
    try:
        datetime.fromisoformat(value)
    except ValueError:
        raise refused(field, value, "not a time such as 2026-01-02T03:04:05+00:00 (ISO 8601)") from None


def _identifier(field: str, value: Any) -> None:
    if not isinstance(value, str):
        raise refused(field, value, "not text")
    plain = value.isascii() and value.replace(".", "_").replace("-", "_").replace("_", "a").isalnum()
    if not plain or len(value) > 128 or not value[0].isalnum():
        raise refused(
            field, value, "not 1 to 128 letters, digits, '.', '_' or '-' starting with a letter or digit"
        )


def _count(limit: int, least: int = 0) -> Callable[[str, Any], None]:
    def check(field: str, value: Any) -> None:
        if type(value) is not int or not least <= value <= limit:
            raise refused(field, value, f"not a count from {least} to {limit}")

    return check


def _integer(field: str, value: Any) -> None:
    if value is not None and (type(value) is not int or not _SEEDS[0] <= value <= _SEEDS[1]):
        raise refused(field, value, "neither null nor a whole number of 64 bits")


def _optional_count(field: str, value: Any) -> None:
    if value is not None and (type(value) is not int or not 1 <= value <= MAX_STEPS):
        raise refused(field, value, f"neither null nor a count from 1 to {MAX_STEPS}")


def _seconds(field: str, value: Any) -> None:
    if type(value) not in (int, float) or not 0 <= value <= MAX_SECONDS:
        raise refused(field, value, f"not a finite number from 0 to {MAX_SECONDS:g}")


def _measure(field: str, value: Any) -> None:
    """A handoff error: finite, or none was taken."""
    if value is not None and (type(value) not in (int, float) or not 0 <= value <= MAX_SECONDS):
        raise refused(field, value, f"neither null nor a finite number from 0 to {MAX_SECONDS:g}")


def _truth(field: str, value: Any) -> None:
    if type(value) is not bool:
        raise refused(field, value, "not true or false")


def _optional_truth(field: str, value: Any) -> None:
    if value is not None and type(value) is not bool:
        raise refused(field, value, "not null, true or false")


def _plain_json(field: str, value: Any, depth: int = _MAX_DEPTH) -> None:
    """Refuses what cannot be written again as JSON in UTF-8, or is nested without end."""
    if depth < 0:
        raise FieldProblem(f"field {field!r}: nested deeper than {_MAX_DEPTH} levels. {REMEDY}")
    if isinstance(value, float) and not math.isfinite(value):
        raise refused(field, value, "not a finite number")
    if isinstance(value, str):
        _text(field, value)
    elif isinstance(value, dict):
        for key, item in value.items():
            _text(field, key)
            _plain_json(field, item, depth - 1)
    elif isinstance(value, list):
        for item in value:
            _plain_json(field, item, depth - 1)


def _object(field: str, value: Any) -> None:
    if not isinstance(value, dict):
        raise refused(field, value, "not a dict")
    _plain_json(field, value)


def _optional_object(field: str, value: Any) -> None:
    if value is not None:
        _object(field, value)


def _versions(field: str, value: Any) -> None:
    _object(field, value)
    for name, version in value.items():
        if not isinstance(version, str) or not (name + version).isprintable() or len(version) > _MAX_NAME:
            raise refused(f"{field}.{name}", version, f"not at most {_MAX_NAME} printable characters")


def _interventions(field: str, value: Any) -> None:
    if not isinstance(value, list):
        raise refused(field, value, "not a list")
    _plain_json(field, value)
    for entry in value:
        if isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], str):
            kind, step, counts = entry[0], entry[1], {}
        elif isinstance(entry, dict) and isinstance(entry.get("kind"), str) and "step" in entry:
            kind, step, counts = entry["kind"], entry["step"], entry
        else:
            raise FieldProblem(
                f"field {field!r}: intervention {shown(entry)} is neither an object with 'kind' and 'step' "
                f"nor a pair of the two. {REMEDY}"
            )
        _NAME(f"{field}.kind", kind)
        if step is not None:
            _STEPS(f"{field}.step", step)
        for name in ("calls", "undone", "extra_steps"):
            if name in counts:
                _STEPS(f"{field}.{name}", counts[name])
        if "solved_in_extra" in counts:
            _truth(f"{field}.solved_in_extra", counts["solved_in_extra"])


def _progress(field: str, value: Any) -> None:
    if value is None:
        return
    good = isinstance(value, list) and 0 < len(value) <= 2 * MAX_STEPS + 1
    if not good or not all(type(share) is int and 0 <= share <= 100 for share in value):
        raise refused(field, value, "neither null nor a list of whole per cents")


def _robot(field: str, value: Any) -> None:
    if problem := robot_problem(value):
        raise FieldProblem(f"field {field!r}: {problem}. {REMEDY}")


def _schema(field: str, value: Any) -> None:
    if type(value) is not int or not 1 <= value <= TRIAL_SCHEMA:
        raise FieldProblem(
            f"trial schema {shown(value)}; this version reads 1 to {TRIAL_SCHEMA}. Upgrade "
            "lerobot_env_roborecover, or use another file"
        )


_NAME = _name(_MAX_NAME, empty=False)
_NAME_OR_EMPTY = _name(_MAX_NAME, empty=True)
_LONG_NAME = _name(_MAX_LONG_NAME, empty=True)
_STEPS = _count(2 * MAX_STEPS)
FIELD_CHECKS: dict[str, Callable[[str, Any], None]] = {
    "schema": _schema,
    "scenario_id": _identifier,
    "scenario_sha256": _sha256,
    "dataset": _LONG_NAME,
    "dataset_revision": _name(_MAX_NAME, empty=True, none=True),
    "platform": _NAME,
    "suite": _NAME,
    "task": _NAME,
    "instruction": _text,
    "stage": _member(Stage),
    "deviation": _member(DeviationType),
    "source": _member(Source),
    "source_policy": _NAME_OR_EMPTY,
    "cluster": _NAME_OR_EMPTY,
    "split": _NAME,
    "start": _member(Start),
    "rewind_steps": _count(MAX_STEPS),
    "handoff_step": _count(MAX_STEPS),
    "trial": _count(MAX_TRIALS),
    "run_seed": _integer,
    "trial_seed": _integer,
    "noise": _NAME,
    "batch_size": _count(MAX_TRIALS),
    "outcome": _member(Outcome),
    "success": _truth,
    "reason": _text,
    "steps": _STEPS,
    "horizon": _count(MAX_STEPS, least=1),
    "handoff_eef_error_mm": _measure,
    "handoff_object_error_mm": _measure,
    "handoff_identical": _optional_truth,
    "handoff_from_snapshot": _optional_truth,
    "handoff_s": _measure,
    "sim_s": _seconds,
    "policy_s": _seconds,
    "actions_sha256": _NAME_OR_EMPTY,
    "interventions": _interventions,
    "policy": _LONG_NAME,
    "execution_horizon": _optional_count,
    "options": _object,
    "versions": _versions,
    "config_hash": _NAME,
    "finished_at": _moment,
    "progress": _progress,
    "first_state": _sha256_or_empty,
    "policy_settings": _optional_object,
    "run_scenarios": _optional_size,
    "run_trials": _optional_size,
    "shard": _shard,
    "robot": _robot,
}
"""A check for every field of a row, in the order of `TrialRow`."""
REPEATED = tuple(
    name
    for name, check in FIELD_CHECKS.items()
    if check in (_identifier, _sha256, _sha256_or_empty, _shard, _LONG_NAME, _NAME, _NAME_OR_EMPTY, _text)
    or name in ("stage", "deviation", "source", "start", "outcome", "dataset_revision")
)
"""Texts that many rows share."""


def settings_of_method(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings that all runs of one method share."""
    return {k: v for k, v in settings.items() if k not in _VOUCHED}


def digest_of(content: Any) -> str:
    """Returns a short hash of JSON-able content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:12]


def short_identity(identity: str) -> str:
    """Returns the first characters of an identity's hash: `callable@1a2b3c4d5e6f` is `1a2b3c`."""
    return identity.rpartition("@")[2].removeprefix("run-")[:6]
