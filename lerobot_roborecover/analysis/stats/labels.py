"""Labels that tell one policy's settings apart: two runs with other options are never averaged together."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any

from lerobot_roborecover.logs.fields import OBJECT, digest_of, short_identity
from lerobot_roborecover.logs.row import TrialRow

_NOT_RECORDED = "settings not recorded"
_SHOWN = 3
_LONGEST = 28


def tell_settings_apart(rows: Sequence[TrialRow]) -> None:
    """Adds what differs to the name of every policy that has rows under several settings, such as
    `act@1a2b [num_inference_steps=2]`. Versions of an object or a callable under one name are numbered in the
    order in which they were evaluated first: `mine [v2, 1a2b3c, newest]`. The rows must be the caller's own:
    their `policy` is changed in place.
    """
    kinds: dict[str, dict[str, list[TrialRow]]] = {}
    keys: dict[int, str] = {}
    for row in rows:
        # Rows of a log share their settings.
        key = keys.setdefault(id(row.policy_settings), _key(row.policy_settings))
        kinds.setdefault(row.policy, {}).setdefault(key, []).append(row)
    for policy, by_settings in kinds.items():
        if len(by_settings) < 2:
            continue
        settings = {key: of[0].policy_settings or {} for key, of in by_settings.items() if key}
        labels = {key: _label(own, settings.values()) for key, own in settings.items()}
        if _telling(settings.values()) == [OBJECT] and all(OBJECT in own for own in settings.values()):
            first = {key: min(row.finished_at for row in by_settings[key]) for key in settings}
            labels = _versions(settings, sorted(settings, key=lambda key: first[key]))
        for key, of in by_settings.items():
            label = labels.get(key, _NOT_RECORDED)
            if list(labels.values()).count(label) > 1:
                label = f"{label}, {digest_of(settings[key])[:4]}"
            for row in of:
                object.__setattr__(row, "policy", f"{policy} [{label}]")


def settings_differences(first: dict[str, Any], second: dict[str, Any]) -> str:
    """Returns the settings in which two rows differ, both values, for a message."""
    names = [name for name in sorted({*first, *second}) if first.get(name) != second.get(name)]
    return ", ".join(f"{name} {_short(first.get(name))} / {_short(second.get(name))}" for name in names)


def _key(settings: dict[str, Any] | None) -> str:
    return "" if settings is None else json.dumps(settings, sort_keys=True)


def _label(own: dict[str, Any], all_settings: Iterable[dict[str, Any]]) -> str:
    """What of a policy's settings is not the same in all of them."""
    telling = _telling(all_settings)
    # An option that is as saved says nothing, unless nothing else is said.
    said = [f"{n}={_short(own[n])}" for n in telling if n in own] or [f"{n} as saved" for n in telling]
    return ", ".join(said[:_SHOWN]) + (", ..." if len(said) > _SHOWN else "") or "as saved"


def _telling(all_settings: Iterable[dict[str, Any]]) -> list[str]:
    """Names of the settings that are not the same in all."""
    everywhere = list(all_settings)
    names = sorted({name for settings in everywhere for name in settings})
    return [n for n in names if any(s.get(n) != everywhere[0].get(n) for s in everywhere)]


def _versions(settings: dict[str, dict[str, Any]], oldest_first: Sequence[str]) -> dict[str, str]:
    """Labels of settings that differ in the policy's identity alone."""
    labels = {}
    for number, key in enumerate(oldest_first, 1):
        newest = ", newest" if number == len(oldest_first) else ""
        labels[key] = f"v{number}, {short_identity(str(settings[key][OBJECT]))}{newest}"
    return labels


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 4]}#{digest_of(value)[:4]}"
