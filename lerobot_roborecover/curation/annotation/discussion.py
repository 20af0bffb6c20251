"""Lists of candidates that the blind pass did not settle, for a further round.

A list holds the votes so far, without names and in an order that tells nothing: people discuss what was said,
not who said it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.annotation.votes import Vote
from lerobot_roborecover.datasets.files import load_json, read_bytes
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.outputs import check_new_file

SCHEMA_VERSION = 1
MAX_BYTES = 2**26
MAX_ROUNDS = 20
_SHOWN = ("verdict", "step", "stage", "deviation", "reason", "comment")


@dataclass(frozen=True)
class Discussion:
    """One further round."""

    round: int
    """2 for the first after the blind pass."""
    candidates: Mapping[str, Mapping[str, Any]]
    """Candidates by id: `why` there was no consensus, and the `votes`."""

    @classmethod
    def of(cls, round_number: int, open_candidates: Mapping[str, tuple[str, Sequence[Vote]]]) -> Discussion:
        """A list from candidates' reasons and votes."""
        return cls(
            round_number,
            {
                name: {
                    "why": why,
                    "votes": sorted(({k: getattr(v, k) for k in _SHOWN} for v in votes), key=str),
                }
                for name, (why, votes) in open_candidates.items()
            },
        )

    def write(self, path: Path) -> None:
        """Writes the list, whole or not at all; an earlier list is replaced.

        Raises:
            OutputExistsError: `path` is something else than a list.
        """
        check_new_file(path, force=_is_discussion(path))
        document = {
            "schema": SCHEMA_VERSION,
            "round": self.round,
            "candidates": [{"id": name, **about} for name, about in self.candidates.items()],
        }
        atomic_write(path, json.dumps(document, indent=1) + "\n")


def _is_discussion(path: Path) -> bool:
    try:
        read_discussion(path)
    except ScenarioError:
        return False
    return True


def read_discussion(path: Path) -> Discussion:
    """Reads a list.

    Raises:
        ScenarioError: it is not one.
    """
    try:
        found = load_json(read_bytes(path.parent, path, MAX_BYTES))
        if found["schema"] != SCHEMA_VERSION or type(found["round"]) is not int:
            raise ValueError(f"schema {found['schema']!r:.40}")
        if not 2 <= found["round"] <= MAX_ROUNDS:
            raise ValueError(f"round {found['round']}; there may be {MAX_ROUNDS}")
        listed = {
            str(c["id"]): {
                "why": str(c["why"]),
                "votes": [{k: v.get(k) for k in _SHOWN} for v in c["votes"]],
            }
            for c in found["candidates"]
        }
    except ScenarioError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as err:
        raise ScenarioError(
            f"{path} is not a list written by `roborecover curate agree --discuss` ({err!r:.200})"
        ) from None
    return Discussion(found["round"], listed)
