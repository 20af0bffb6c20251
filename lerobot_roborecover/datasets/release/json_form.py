"""A record's JSON: read as strictly as a file from anyone needs, and written back byte for byte."""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_roborecover.scenario import Scenario, ScenarioError

MAX_DEPTH = 64
KEY = "release"
"""Where a scenario's provenance holds what `to_json` and the export need."""


def parse_json(data: bytes) -> dict[str, Any]:
    """The fields of a record.

    Raises:
        ScenarioError: it is no JSON object in UTF-8 of finite numbers, Unicode text and unique names.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) != len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"the field {twice!r:.80} occurs twice")
        return found

    def refuse(name: str) -> None:
        raise ValueError(f"it holds {name}; numbers must be finite")

    def finite(text: str) -> float:
        # JSON's reader takes 1e999 for infinity.
        number = float(text)
        if math.isinf(number):
            raise ValueError(f"it holds {text:.40}, which is infinite as a float64; numbers must be finite")
        return number

    try:
        # Decoded here: JSON's reader takes UTF-16 and UTF-32, too, which no record of the release is in.
        text = data.decode("utf-8-sig")
        record = json.loads(text, parse_constant=refuse, parse_float=finite, object_pairs_hook=unique)
        # Half of an escaped surrogate pair is no text, though JSON's reader takes it.
        json.dumps(record, ensure_ascii=False, allow_nan=False).encode()
    except UnicodeDecodeError as err:
        raise ScenarioError(f"not usable JSON: not in UTF-8 ({err.reason} at byte {err.start})") from None
    except (ValueError, RecursionError) as err:
        ends = isinstance(err, json.JSONDecodeError) and (
            err.pos >= len(err.doc.rstrip()) or err.msg.startswith("Unterminated")
        )
        early = f"; the file ends in the middle of its record, after {len(data)} bytes" if ends else ""
        raise ScenarioError(f"not usable JSON: {err}{early}") from None
    if not isinstance(record, dict):
        raise ScenarioError(f"a JSON {type(record).__name__}, not an object with a record's fields")
    return record


def texts_of(value: object) -> list[str]:
    """Returns the texts in a JSON value, names of fields among them.

    Raises:
        ScenarioError: the value is nested deeper than `MAX_DEPTH`.
    """
    found: list[str] = []
    level = [value]
    for _ in range(MAX_DEPTH):
        if not level:
            return found
        inner: list[object] = []
        for item in level:
            if isinstance(item, str):
                found.append(item)
            elif isinstance(item, dict):
                inner += [*item, *item.values()]
            elif isinstance(item, list):
                inner += item
        level = inner
    raise ScenarioError(f"JSON nested more than {MAX_DEPTH} deep; a record has a few levels")


def to_json(scenario: Scenario) -> bytes:
    """The scenario's file as it was, byte for byte.

    Raises:
        ScenarioError: the scenario was not made from the release.
    """
    try:
        note = scenario.provenance[KEY]
        form = note["json"]
        if "zlib" in form:
            unpacker = zlib.decompressobj()
            data = unpacker.decompress(base64.b64decode(form["zlib"]), 2**24)
            if unpacker.unconsumed_tail:
                raise ValueError("more than 16 MiB")
            return data
        rows = [*scenario.prefix.tolist(), *note.get("tail", [])]
        if "integers" in note:
            width = scenario.prefix.shape[1]
            flags = np.unpackbits(np.frombuffer(bytes.fromhex(note["integers"]), np.uint8))
            for i in np.flatnonzero(flags[: len(rows) * width]):
                rows[i // width][i % width] = int(rows[i // width][i % width])
        return _dump({**note["record"], "actions": rows}, form)
    except (KeyError, TypeError, ValueError, IndexError, zlib.error) as err:
        raise ScenarioError(
            f"scenario {scenario.id}, field provenance.{KEY}: not what the conversion of a release writes "
            f"({err!r:.100}); only converted scenarios can be exported"
        ) from None


def form_of(data: bytes, record: Mapping[str, Any]) -> dict[str, Any]:
    """How the file was written: what `_dump` needs to write it again, or the file itself, packed."""
    text = data.decode("utf-8")
    body = text.rstrip()
    form: dict[str, Any] = {"ascii": text.isascii(), "end": text[len(body) :]}
    if body.startswith("{\n"):
        form["indent"] = len(body) - len(body[2:].lstrip(" ")) - 2
    elif body[:1] == "{":
        form["separators"] = [", ", ": "] if '": ' in body else [",", ":"]
    if len(form["end"]) <= 2 and form.get("indent", 0) <= 8 and _dump(record, form) == data:
        return form
    return {"zlib": base64.b64encode(zlib.compress(data, 9)).decode()}


def _dump(record: Mapping[str, Any], form: Mapping[str, Any]) -> bytes:
    separators = form.get("separators")
    text = json.dumps(
        record,
        ensure_ascii=form["ascii"],
        indent=form.get("indent"),
        separators=tuple(separators) if separators else None,
        allow_nan=False,
    )
    return (text + form["end"]).encode("utf-8")
