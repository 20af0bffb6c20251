"""What stands beside the log of a run that was watched: `trials.sequential.json` beside `trials.jsonl`.

It names the comparison that the run was to decide, and the scenarios that belonged to it. A report that meets
the log later knows by it that missing scenarios were not run because the question was settled, and takes the
test that was made for being looked at.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from lerobot_roborecover.logs.trial_log import TrialLogError
from lerobot_roborecover.utils.atomic_io import atomic_write

SEQUENTIAL_SCHEMA = 1
_MOST_BYTES = 64 * 2**20


@dataclass(frozen=True)
class SequentialRecord:
    """One run that compares itself with a stored log while it goes."""

    policy: str
    """As its rows say."""
    config_hash: str
    """Config hash of its rows."""
    start: str
    trials: int
    """Trials of every scenario."""
    scenarios: tuple[str, ...]
    """Ids of all that belonged to the run, in the order in which they were run and count."""
    level: float
    against: str
    """The other policy, as its rows say."""
    against_config_hash: str
    against_log: str
    """File name."""
    against_sha256: str
    decided: bool = False
    after_scenarios: int = 0
    """Scenarios that the decision rests on, or that count so far."""
    p: float | None = None
    """Two-sided, valid whenever it is looked at."""
    words: str = ""
    """The decision in a sentence."""
    units: tuple[str, ...] = ()
    """Label of the independent unit of every scenario; empty in records of earlier versions."""
    against_trials: int = 0
    """Planned trials of the other policy on every scenario; 0 where its log was whole at the start."""
    against_outcomes: str = ""
    """SHA-256 of the other policy's rates, which must stay as they were; empty where they may still come."""


def record_path(log: Path) -> Path:
    """Where a log's record stands."""
    return log.with_name(f"{log.stem}.sequential.json")


def write_record(log: Path, record: SequentialRecord) -> Path:
    """Writes the record of a log; returns its file."""
    path = record_path(log)
    atomic_write(path, json.dumps({"schema": SEQUENTIAL_SCHEMA, **asdict(record)}, indent=1) + "\n")
    return path


def read_record(log: Path) -> SequentialRecord | None:
    """The record of a log; None where the run was not watched.

    Raises:
        TrialLogError: there is one that cannot be read; names the file, the field and the remedy.
    """
    path = record_path(log)
    if not path.is_file():
        return None
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"larger than {_MOST_BYTES} bytes")
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict) or values.pop("schema", None) != SEQUENTIAL_SCHEMA:
            raise ValueError(f"field 'schema' is not {SEQUENTIAL_SCHEMA}")
        return _checked(values)
    except (OSError, ValueError, RecursionError) as err:
        raise TrialLogError(
            f"{path}: {err}. It says how the run of {log.name} was watched; bring back the file that "
            "`roborecover eval --sequential` wrote"
        ) from None


_KINDS = {
    "str": str,
    "int": int,
    "float": (int, float),
    "bool": bool,
    "float | None": (int, float, type(None)),
    "tuple[str, ...]": list,
}


_LATER: dict[str, Any] = {"units": [], "against_trials": 0, "against_outcomes": ""}
"""Fields that records of earlier versions lack."""


def _checked(values: dict[str, Any]) -> SequentialRecord:
    values = {**_LATER, **values}
    for field in fields(SequentialRecord):
        value = values.get(field.name)
        kind = _KINDS[str(field.type)]
        wrong = not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool)
        if not wrong and isinstance(value, list):
            wrong = not all(isinstance(item, str) and item for item in value)
        if wrong:
            raise ValueError(f"field {field.name!r}: {str(value)[:80]!r} is not a {field.type}")
    if not 0.5 <= values["level"] < 1:
        raise ValueError(f"field 'level': {values['level']} is not from 0.5 to 1")
    if len(set(values["scenarios"])) != len(values["scenarios"]) or not values["scenarios"]:
        raise ValueError("field 'scenarios': ids must be there, each once")
    known: dict[str, Any] = {field.name: values[field.name] for field in fields(SequentialRecord)}
    known["scenarios"], known["units"] = tuple(values["scenarios"]), tuple(values["units"])
    if known["units"] and len(known["units"]) != len(known["scenarios"]):
        raise ValueError("field 'units': there must be one for every scenario")
    return SequentialRecord(**known)
