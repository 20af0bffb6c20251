"""Records by themselves, without a split table: the release's public examples."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from lerobot_roborecover.datasets.release.convert import (
    Conversion,
    Problem,
    read_record,
    warn_of_instructions,
)
from lerobot_roborecover.datasets.release.record import RULES, Reading, look
from lerobot_roborecover.datasets.release.tables import (
    MAX_RECORD_BYTES,
    SPLITS,
    SplitRow,
    SplitTable,
    read_file,
)
from lerobot_roborecover.scenario import ScenarioError

_REMEDY = "Fetch the file again; if it is the same then, tell those who published it"


def read_files(paths: Sequence[Path], reading: Reading = RULES) -> list[Conversion]:
    """Reads single records; a file's name is its scenario's id.

    Args:
        paths: JSON files of the release, of any of the platforms. One that lies in a folder `train` is of
            that split, any other of `test`; all of its actions are the prefix.
        reading: what is taken.

    Returns:
        One conversion a platform. What is no record of either is a failure of the first.
    """
    results: dict[str, Conversion] = {}
    unknown: list[Problem] = []
    taken: set[str] = set()
    for path in paths:
        try:
            data = read_file(path.parent, PurePosixPath(path.name), MAX_RECORD_BYTES)
            platform, task, count, labels = look(data)
        except ScenarioError as err:
            unknown.append(Problem(str(path), None, path.stem, f"{err}. {_REMEDY}"))
            continue
        result = results.setdefault(platform, Conversion(platform))
        split = path.resolve().parent.name if path.resolve().parent.name in SPLITS else SPLITS[-1]
        name = PurePosixPath(platform, split, f"{path.stem}.json")
        cells = {
            "sample_id": path.stem,
            "path": str(name),
            "sha256": hashlib.sha256(data).hexdigest(),
            "original_sha256": "",
            "actions": str(count),
            "replay_prefix_steps": str(count),
            "task_name": task,
            "s_stage": labels[0],
            "d_stage": labels[1],
        }
        number = 1 + sum(s.split == split for s in result.scenarios)
        try:
            if path.stem in taken:
                raise ScenarioError(f"another file is named {path.name} too; rename one, its name is its id")
            taken.add(path.stem)
            result.scenarios.append(
                read_record(
                    platform,
                    data,
                    SplitTable("", split, [cells], "\n", False, True),
                    SplitRow(number, cells, name, count, count),
                    reading,
                    _REMEDY,
                )
            )
        except ScenarioError as err:
            result.failures.append(Problem(str(path), None, path.stem, str(err)))
            continue
        result.warnings.append(
            Problem(
                str(path), None, path.stem,
                f"no split table: its id is the file's name, its split {split}, its prefix all of its "
                f"{count} actions, and no hash says that it is the file that was released",
            )
        )  # fmt: skip
    if unknown:
        first = next(iter(results.values()), None) or results.setdefault("libero", Conversion("libero"))
        first.failures.extend(unknown)
    for result in results.values():
        warn_of_instructions(result)
    return list(results.values())
