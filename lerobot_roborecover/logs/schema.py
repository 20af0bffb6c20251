"""What a row of a trial log may hold, field by field: logs come from anywhere and are trusted after this.

What rows repeat (names, options, versions) is kept once: a log of 100,000 trials has a few hundred texts.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from lerobot_roborecover.logs.fields import (
    FIELD_CHECKS,
    REMEDY,
    REPEATED,
    TRIAL_SCHEMA,
    FieldProblem,
    refused,
    shown,
)
from lerobot_roborecover.scenario import Outcome

_NAMES = frozenset(FIELD_CHECKS)
_SHARED = ("options", "versions", "policy_settings")
"""Objects that many rows share."""
_OWN = tuple(item for item in FIELD_CHECKS.items() if item[0] not in (*REPEATED, *_SHARED, "interventions"))
"""Fields whose value is the row's alone."""
_RARE = ("reason", "actions_sha256")
"""Texts among the repeated that need not be: remembering all of them would keep them all."""


class RowChecker:
    """Checks records of one log, and gives rows that repeat a value the same object.

    What was found good once is not looked at again, so a long log costs little more than reading its JSON.
    """

    def __init__(self) -> None:
        self._texts: dict[str, dict[str, str]] = {name: {} for name in REPEATED}
        self._objects: dict[str, dict[str, dict]] = {name: {} for name in _SHARED}

    def check(self, record: object) -> dict[str, Any]:
        """The record, its repeated values shared.

        Args:
            record: a line's JSON.

        Raises:
            FieldProblem: it is no trial row.
        """
        if not isinstance(record, dict):
            raise FieldProblem(f"a JSON {type(record).__name__}, not an object with a row's fields. {REMEDY}")
        FIELD_CHECKS["schema"]("schema", record.get("schema"))
        if record["schema"] < TRIAL_SCHEMA:
            _upgrade(record)
        if record.keys() != _NAMES:
            odd = min(record.keys() ^ _NAMES)
            raise FieldProblem(f"field {shown(odd)} is missing or not known. {REMEDY}")
        for name, check in _OWN:
            check(name, record[name])
        for name, known in self._texts.items():
            value = record[name]
            try:
                record[name] = known[value]
            except (KeyError, TypeError):
                FIELD_CHECKS[name](name, value)
                if value is not None and name not in _RARE:
                    known[value] = value
        for name, shared in self._objects.items():
            record[name] = self._shared(name, record[name], shared)
        if record["interventions"] != []:
            FIELD_CHECKS["interventions"]("interventions", record["interventions"])
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
        FIELD_CHECKS[name](name, value)
        if key is not None:
            known[key] = value
        return value


_ADDED = {
    "first_state": "",
    "policy_settings": None,
    "run_scenarios": None,
    "run_trials": None,
    "shard": "",
    "robot": None,
}


def _upgrade(record: dict[str, Any]) -> None:
    """Makes a row of an earlier schema one of today's, which says nothing of what it lacks."""
    if record["schema"] == 1:
        record.setdefault("progress", None)
    for name, unsaid in _ADDED.items():
        record.setdefault(name, unsaid)
    record["schema"] = TRIAL_SCHEMA


def _check_together(record: Mapping[str, Any]) -> None:
    """What fields say about one another."""
    outcome, success, steps, horizon = (record[n] for n in ("outcome", "success", "steps", "horizon"))
    if success is not (outcome == Outcome.SUCCESS):
        raise FieldProblem(
            f"field 'success': success is {success!r} but the outcome is {outcome!r}. {REMEDY}"
        )
    # On a robot a person ends a failed trial, often before its time is up.
    if outcome == Outcome.HORIZON and steps < horizon and record["robot"] is None:
        raise refused("steps", steps, f"but the outcome is 'horizon', after all of {horizon} steps")
    if steps > horizon and not (record["interventions"] and not Outcome(outcome).valid):
        # A trial that broke while it ran on after a rollback has taken more; its outcome is invalid.
        raise refused("steps", steps, f"more than the horizon of {horizon} steps")


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise FieldProblem(f"field {shown(twice)} occurs twice. {REMEDY}")
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
        raise FieldProblem(f"not a JSON trial row (nested too deeply). {REMEDY}") from None
    except UnicodeDecodeError as err:
        raise FieldProblem(f"not UTF-8 text ({err}); this is not a trial log. Name another file") from None
    except ValueError as err:
        raise FieldProblem(
            f"not a JSON trial row ({str(err)[:200]}). Only a last line can be cut off by a crash; this one "
            "is damaged. Remove the line to run its trial again"
        ) from None
