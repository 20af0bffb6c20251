"""A trial log that a command keeps for itself: rows of another policy or setting are moved out of it."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from lerobot_roborecover.platforms.versions import row_versions
from lerobot_roborecover.policies.identity import content_hash, policy_identity
from lerobot_roborecover.utils.atomic_io import atomic_write

IDENTITY_FILE = "identity.json"
"""Beside the log: whose rows it holds."""


def identity_of_run(platform: str, policy: Mapping[str, Any], **others: Any) -> dict[str, Any]:
    """Returns what all rows of a run's log must share.

    Args:
        platform: of its scenarios.
        policy: options of the policy, members as mappings; the content of a checkpoint or a mapping file
            takes the place of its path.
        others: whatever else decides the run's results, JSON-able.
    """
    versions = row_versions(platform) if platform else {}
    return json.loads(
        json.dumps({"policy": _by_content(policy), "versions": versions, **others}, default=str)
    )


def claim_log(log: Path, identity: Mapping[str, Any], say: Callable[[str], None] = print) -> None:
    """Makes a log the run's own: one with rows of another identity, or of an unknown one, is moved aside.

    Args:
        log: the trial log; need not exist.
        identity: of `identity_of_run`.
        say: takes the line that says what was moved.
    """
    beside = log.with_name(IDENTITY_FILE)
    text = json.dumps(identity, indent=1, sort_keys=True) + "\n"
    if beside.is_file() and beside.read_text(encoding="utf-8") == text:
        return
    if log.exists() and log.stat().st_size:
        there = next(path for path in _names(log) if not path.exists())
        os.replace(log, there)
        say(
            f"{log} holds trials of another policy or setting, or of an earlier version that does not say: "
            f"they are not reused, and are now in {there}"
        )
    atomic_write(beside, text)


def _names(log: Path) -> Iterator[Path]:
    number = 0
    while True:
        number += 1
        yield log.with_name(f"{log.name}.before-{number}")


def _by_content(policy: Mapping[str, Any]) -> dict[str, Any]:
    found = {}
    for name, value in policy.items():
        if isinstance(value, Mapping):
            found[name] = _by_content(value)
        elif name == "path" and value:
            found[name] = policy_identity(str(value), policy.get("revision"))
        elif isinstance(value, str) and value.endswith((".yaml", ".yml")) and Path(value).is_file():
            found[name] = content_hash(Path(value))
        else:
            found[name] = value
    return found
