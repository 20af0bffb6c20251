"""What a row of a trial log may hold, field by field: logs come from anywhere and are trusted after this.

The limits are those of what can be run: names as the scenario format has them, steps within the horizon. What
rows repeat (names, options, versions) is kept once: a log of 100,000 trials has a few hundred texts.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from datetime import datetime
from enum import StrEnum
from typing import Any

from lerobot_roborecover.scenario import DeviationType, Outcome, Source, Stage, Start

TRIAL_SCHEMA = 3
"""1: rows without `progress`. 2: rows without `first_state`, `policy_settings`, `run_scenarios`, `run_trials`
and `shard`. Both are read as rows that say nothing of these."""
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
_REMEDY = "Correct the line, or remove it to run its trial again"


class FieldProblem(ValueError):
    """A record is no trial row; the message names the field, the value and the limit."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split("\n")))


def _shown(value: object) -> str:
    try:
        text = repr(value)
    except RecursionError:
        text = f"a deeply nested {type(value).__name__}"
    return text if len(text) <= 80 else f"{text[:79]}…"


def _refuse(field: str, value: object, rule: str) -> FieldProblem:
    return FieldProblem(f"field {field!r}: {field} is {_shown(value)}, {rule}. {_REMEDY}")


def _name(limit: int, *, empty: bool, none: bool = False) -> Callable[[str, Any], None]:
    def check(field: str, value: Any) -> None:
        if none and value is None:
            return
        if not isinstance(value, str):
            raise _refuse(field, value, "not text")
        if len(value) > limit or not value.isprintable() or not (value or empty):
            least = 0 if empty else 1
            raise _refuse(field, value, f"not {least} to {limit} printable characters")

    return check


def _text(field: str, value: Any) -> None:
    if not isinstance(value, str):
        raise _refuse(field, value, "not text")
    if len(value) > MAX_TEXT:
        raise _refuse(field, value, f"with {len(value)} characters; the limit is {MAX_TEXT}")
    try:
        value.encode()
    except UnicodeEncodeError:  # JSON's escapes can smuggle halves of characters in
        raise _refuse(
            field, value, "with half a character (a lone surrogate), which is no Unicode text"
        ) from None


def _member(enum: type[StrEnum]) -> Callable[[str, Any], None]:
    known = [str(member) for member in enum]

    def check(field: str, value: Any) -> None:
        if not isinstance(value, str) or value not in known:
            raise FieldProblem(f"field {field!r}: {field} {_shown(value)} is not one of {known}. {_REMEDY}")

    return check


def _sha256(field: str, value: Any) -> None:
    if not isinstance(value, str) or len(value) != 64 or set(value) - set("0123456789abcdef"):
        raise _refuse(field, value, "not a SHA-256 of 64 hexadecimal digits")


def _sha256_or_empty(field: str, value: Any) -> None:
    if value != "":
        _sha256(field, value)


def _optional_size(field: str, value: Any) -> None:
    if value is not None and (type(value) is not int or not 1 <= value <= MAX_TRIALS):
        raise _refuse(field, value, f"neither null nor a count from 1 to {MAX_TRIALS}")


def _shard(field: str, value: Any) -> None:
    if value == "":
        return
    k, _, n = value.partition("/") if isinstance(value, str) else ("", "", "")
    good = all(part.isascii() and part.isdigit() and len(part) <= 7 for part in (k, n))
    if not good or not int(k) < int(n):
        raise _refuse(field, value, "neither empty nor k/n with k from 0 to n - 1")


def _moment(field: str, value: Any) -> None:
    if not isinstance(value, str):
        raise _refuse(field, value, "not text")
    try:
        datetime.fromisoformat(value)
    except ValueError:
        raise _refuse(field, value, "not a time such as 2026-01-02T03:04:05+00:00 (ISO 8601)") from None


def _identifier(field: str, value: Any) -> None:
    if not isinstance(value, str):
        raise _refuse(field, value, "not text")
    plain = value.isascii() and value.replace(".", "_").replace("-", "_").replace("_", "a").isalnum()
    if not plain or len(value) > 128 or not value[0].isalnum():
        raise _refuse(
            field, value, "not 1 to 128 letters, digits, '.', '_' or '-' starting with a letter or digit"
        )


def _count(limit: int, least: int = 0) -> Callable[[str, Any], None]:
    def check(field: str, value: Any) -> None:
        if type(value) is not int or not least <= value <= limit:
            raise _refuse(field, value, f"not a count from {least} to {limit}")

    return check


def _integer(field: str, value: Any) -> None:
    if value is not None and (type(value) is not int or not _SEEDS[0] <= value <= _SEEDS[1]):
        raise _refuse(field, value, "neither null nor a whole number of 64 bits")


def _optional_count(field: str, value: Any) -> None:
    if value is not None and (type(value) is not int or not 1 <= value <= MAX_STEPS):
        raise _refuse(field, value, f"neither null nor a count from 1 to {MAX_STEPS}")


def _seconds(field: str, value: Any) -> None:
    if type(value) not in (int, float) or not 0 <= value <= MAX_SECONDS:
        raise _refuse(field, value, f"not a finite number from 0 to {MAX_SECONDS:g}")


def _measure(field: str, value: Any) -> None:
    """A handoff error: finite, or none was taken."""
    if value is not None and (type(value) not in (int, float) or not 0 <= value <= MAX_SECONDS):
        raise _refuse(field, value, f"neither null nor a finite number from 0 to {MAX_SECONDS:g}")


def _truth(field: str, value: Any) -> None:
    if type(value) is not bool:
        raise _refuse(field, value, "not true or false")


def _optional_truth(field: str, value: Any) -> None:
    if value is not None and type(value) is not bool:
        raise _refuse(field, value, "not null, true or false")


def _plain_json(field: str, value: Any, depth: int = _MAX_DEPTH) -> None:
    """Refuses what cannot be written again as JSON in UTF-8, or is nested without end."""
    if depth < 0:
        raise FieldProblem(f"field {field!r}: nested deeper than {_MAX_DEPTH} levels. {_REMEDY}")
    if isinstance(value, float) and not math.isfinite(value):
        raise _refuse(field, value, "not a finite number")
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
        raise _refuse(field, value, "not a dict")
    _plain_json(field, value)


def _optional_object(field: str, value: Any) -> None:
    if value is not None:
        _object(field, value)


def _versions(field: str, value: Any) -> None:
    _object(field, value)
    for name, version in value.items():
        if not isinstance(version, str) or not (name + version).isprintable() or len(version) > _MAX_NAME:
            raise _refuse(f"{field}.{name}", version, f"not at most {_MAX_NAME} printable characters")


def _interventions(field: str, value: Any) -> None:
    if not isinstance(value, list):
        raise _refuse(field, value, "not a list")
    _plain_json(field, value)
    for entry in value:
        if isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], str):
            kind, step, counts = entry[0], entry[1], {}
        elif isinstance(entry, dict) and isinstance(entry.get("kind"), str) and "step" in entry:
            kind, step, counts = entry["kind"], entry["step"], entry
        else:
            raise FieldProblem(
                f"field {field!r}: intervention {_shown(entry)} is neither an object with 'kind' and 'step' "
                f"nor a pair of the two. {_REMEDY}"
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
        raise _refuse(field, value, "neither null nor a list of whole per cents")


def _schema(field: str, value: Any) -> None:
    if type(value) is not int or not 1 <= value <= TRIAL_SCHEMA:
        raise FieldProblem(
            f"trial schema {_shown(value)}; this version reads 1 to {TRIAL_SCHEMA}. Upgrade "
            "lerobot_env_roborecover, or use another file"
        )


_NAME = _name(_MAX_NAME, empty=False)
_NAME_OR_EMPTY = _name(_MAX_NAME, empty=True)
_LONG_NAME = _name(_MAX_LONG_NAME, empty=True)
_STEPS = _count(2 * MAX_STEPS)
_CHECKS: dict[str, Callable[[str, Any], None]] = {
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
}
"""A check for every field of a row, in the order of `TrialRow`."""
_NAMES = frozenset(_CHECKS)
_REPEATED = tuple(
    name
    for name, check in _CHECKS.items()
    if check in (_identifier, _sha256, _sha256_or_empty, _shard, _LONG_NAME, _NAME, _NAME_OR_EMPTY, _text)
    or name in ("stage", "deviation", "source", "start", "outcome", "dataset_revision")
)
"""Texts that many rows share."""
_SHARED = ("options", "versions", "policy_settings")
"""Objects that many rows share."""
_OWN = tuple(item for item in _CHECKS.items() if item[0] not in (*_REPEATED, *_SHARED, "interventions"))
"""Fields whose value is the row's alone."""
_RARE = ("reason", "actions_sha256")
"""Texts among the repeated that need not be: remembering all of them would keep them all."""


class RowChecker:
    """Checks records of one log, and gives rows that repeat a value the same object.

    What was found good once is not looked at again, so a long log costs little more than reading its JSON.
    """

    def __init__(self) -> None:
        self._texts: dict[str, dict[str, str]] = {name: {} for name in _REPEATED}
        self._objects: dict[str, dict[str, dict]] = {name: {} for name in _SHARED}

    def check(self, record: object) -> dict[str, Any]:
        """The record, its repeated values shared.

        Args:
            record: a line's JSON.

        Raises:
            FieldProblem: it is no trial row.
        """
        if not isinstance(record, dict):
            raise FieldProblem(
                f"a JSON {type(record).__name__}, not an object with a row's fields. {_REMEDY}"
            )
        _schema("schema", record.get("schema"))
        if record["schema"] < TRIAL_SCHEMA:
            _upgrade(record)
        if record.keys() != _NAMES:
            odd = min(record.keys() ^ _NAMES)
            raise FieldProblem(f"field {_shown(odd)} is missing or not known. {_REMEDY}")
        for name, check in _OWN:
            check(name, record[name])
        for name, known in self._texts.items():
            value = record[name]
            try:
                record[name] = known[value]
            except (KeyError, TypeError):
                _CHECKS[name](name, value)
                if value is not None and name not in _RARE:
                    known[value] = value
        for name, shared in self._objects.items():
            record[name] = self._shared(name, record[name], shared)
        if record["interventions"] != []:
            _interventions("interventions", record["interventions"])
        _check_together(record)
        return record

    @staticmethod
    def _shared(name: str, value: Any, known: dict[str, dict]) -> dict:
        try:
            key = repr(value)
        except RecursionError:
            key = None
        found = known.get(key) if key is not None else None
        if found is not None:
            return found
        _CHECKS[name](name, value)
        if key is not None:
            known[key] = value
        return value


_SINCE_3 = {
    "first_state": "",
    "policy_settings": None,
    "run_scenarios": None,
    "run_trials": None,
    "shard": "",
}


def _upgrade(record: dict[str, Any]) -> None:
    """Makes a row of an earlier schema one of today's, which says nothing of what it lacks."""
    if record["schema"] == 1:
        record.setdefault("progress", None)
    for name, unsaid in _SINCE_3.items():
        record.setdefault(name, unsaid)
    record["schema"] = TRIAL_SCHEMA


def _check_together(record: Mapping[str, Any]) -> None:
    """What fields say about one another."""
    outcome, success, steps, horizon = (record[n] for n in ("outcome", "success", "steps", "horizon"))
    if success is not (outcome == Outcome.SUCCESS):
        raise FieldProblem(
            f"field 'success': success is {success!r} but the outcome is {outcome!r}. {_REMEDY}"
        )
    if outcome == Outcome.HORIZON and steps < horizon:
        raise _refuse("steps", steps, f"but the outcome is 'horizon', after all of {horizon} steps")
    if steps > horizon and not (record["interventions"] and not Outcome(outcome).valid):
        # A trial that broke while it ran on after a rollback has taken more; its outcome is invalid.
        raise _refuse("steps", steps, f"more than the horizon of {horizon} steps")


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise FieldProblem(f"field {_shown(twice)} occurs twice. {_REMEDY}")
    return found


def parse_json(line: bytes) -> object:
    """One line's JSON. Python's reader takes NaN and infinities; the check of the field refuses them by name.

    Raises:
        FieldProblem: it is not JSON in UTF-8, or is nested without end.
    """
    try:
        return json.loads(line.decode("utf-8"), object_pairs_hook=_without_duplicates)
    except FieldProblem:
        raise
    except RecursionError:
        raise FieldProblem(f"not a JSON trial row (nested too deeply). {_REMEDY}") from None
    except UnicodeDecodeError as err:
        raise FieldProblem(f"not UTF-8 text ({err}); this is not a trial log. Name another file") from None
    except ValueError as err:
        raise FieldProblem(
            f"not a JSON trial row ({str(err)[:200]}). Only a last line can be cut off by a crash; this one "
            "is damaged. Remove the line to run its trial again"
        ) from None
