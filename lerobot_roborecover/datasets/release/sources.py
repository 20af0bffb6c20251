"""The controller of a rollout of the release, from the name that its record gives."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from lerobot_roborecover.datasets.release.tables import MAX_TABLE_BYTES, read_file
from lerobot_roborecover.scenario import ScenarioError, Source


@dataclass(frozen=True)
class Sources:
    """The controller, from the name that a record gives; the rules are those of `docs/publish.md`."""

    table: Mapping[str, tuple[Source, str]] = field(default_factory=dict)
    """Names that the rules get wrong: source and source policy by `model_name` or `policy_name`."""

    def of(self, name: str) -> tuple[Source, str]:
        """Source and source policy of a recorded name."""
        if name in self.table:
            return self.table[name]
        lower = name.lower()
        if lower.endswith("_disturb"):
            return Source.PERTURBED, name[: -len("_disturb")]
        if lower.startswith(("human", "teleop", "spacemouse", "operator")):
            return Source.HUMAN, name
        return Source.NATURAL, name


def read_sources(path: str | os.PathLike[str]) -> Sources:
    """Reads exceptions to the rules of sources: a CSV with columns name, source, source_policy.

    Raises:
        ScenarioError: the file is no such table.
    """
    path = Path(path)
    data = read_file(path.parent, PurePosixPath(path.name), MAX_TABLE_BYTES)
    rows = list(csv.DictReader(io.StringIO(data.decode("utf-8-sig", "replace"), newline="")))
    table = {}
    for number, row in enumerate(rows, 1):
        if set(row) != {"name", "source", "source_policy"} or None in row.values():
            raise ScenarioError(f"{path}, row {number}: the columns must be name, source, source_policy")
        if row["source"] not in set(Source):
            raise ScenarioError(
                f"{path}, row {number}, column source: {row['source']!r:.80} is not one of "
                f"{', '.join(Source)}"
            )
        table[row["name"]] = (Source(row["source"]), row["source_policy"])
    return Sources(table)
