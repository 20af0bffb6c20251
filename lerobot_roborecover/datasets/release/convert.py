"""A whole release as scenarios: membership, hashes and leakage checked; what fails is reported, the rest goes
on."""

from __future__ import annotations

import csv
import hashlib
import io
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from lerobot_roborecover.datasets.release.record import KEY, RULES, Sources, to_json, to_scenario
from lerobot_roborecover.datasets.release.tables import (
    MAX_RECORD_BYTES,
    MAX_TABLE_BYTES,
    PLATFORMS,
    SPLITS,
    SplitRow,
    SplitTable,
    check_row,
    format_table,
    read_file,
    read_table,
    safe_path,
    table_name,
)
from lerobot_roborecover.datasets.schema import check_limits
from lerobot_roborecover.scenario import Scenario, ScenarioError, Source
from lerobot_roborecover.whole import new_folder


@dataclass(frozen=True)
class Problem:
    """What is wrong with one file or row."""

    file: str
    row: int | None
    """Row of the split table, counted from 1 below the header."""
    sample_id: str
    message: str
    """Field, value and remedy."""

    def __str__(self) -> str:
        at = f", row {self.row}" if self.row is not None else ""
        return f"{self.file}{at}: {self.message}"


@dataclass
class Conversion:
    """What became of a release's records of one platform."""

    platform: str
    scenarios: list[Scenario] = field(default_factory=list)
    failures: list[Problem] = field(default_factory=list)
    """Records that were refused; none of them is among the scenarios."""
    warnings: list[Problem] = field(default_factory=list)


def platforms_of(root: Path) -> list[str]:
    """The platforms for which a release has a split table."""
    return [p for p in PLATFORMS if any((root / table_name(p, s)).exists() for s in SPLITS)]


def read_release(
    root: str | os.PathLike[str],
    platform: str,
    *,
    sources: Sources = RULES,
    keep_extra: bool = False,
) -> Conversion:
    """Reads every record of one platform.

    Args:
        root: the release's folder, the one that holds `splits/`.
        platform: `libero` or `robotwin`.
        sources: tells natural, perturbed and human records apart.
        keep_extra: keep unknown fields in the provenance instead of refusing their records.

    Raises:
        ScenarioError: there is no split table, or one is no table of the release format. A bad record raises
            nothing: it is among the failures.
    """
    root = Path(root)
    result = Conversion(platform)
    tables = [t for t in (read_table(root, platform, s) for s in SPLITS) if t is not None]
    if not tables:
        raise ScenarioError(
            f"{root} has no {table_name(platform, 'train')} or {table_name(platform, 'test')}; name the "
            "release's folder, the one that holds splits/"
        )
    hashes: dict[tuple[str, str], str] = {}
    for table, row in _usable_rows(tables, result):
        name = str(row.path)
        try:
            data = read_file(root, row.path, MAX_RECORD_BYTES)
            digest = hashlib.sha256(data).hexdigest()
            if digest != row.cells["sha256"]:
                raise ScenarioError(
                    f"SHA-256 is {digest}, {table.name} (row {row.number}, column sha256) says "
                    f"{row.cells['sha256']}: the file is not the one that was released. Fetch it again"
                )
            scenario = to_scenario(
                platform,
                data,
                split=table.split,
                sample_id=row.sample_id,
                prefix_steps=row.replay_prefix_steps,
                sources=sources,
                keep_extra=keep_extra,
            )
            _check_against_row(scenario, row)
            note = {
                **scenario.provenance[KEY],
                "split_row": row.cells,
                "row": row.number,
                "table": {"newline": table.newline, "bom": table.bom},
            }
            scenario = replace(scenario, provenance={KEY: note})
            check_limits(scenario)
        except ScenarioError as err:
            result.failures.append(Problem(name, None, row.sample_id, _without_name(err, name)))
            continue
        result.scenarios.append(scenario)
        hashes[(table.split, row.sample_id)] = digest
    _refuse_leaks(result, hashes)
    _report_unlisted(root, tables, result)
    for table in tables:
        if not table.reproducible:
            result.warnings.append(
                Problem(
                    table.name,
                    None,
                    "",
                    "its quoting is unusual: an export equals it in content, not in bytes",
                )
            )
    return result


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


def export_release(scenarios: Sequence[Scenario], out: str | os.PathLike[str]) -> list[Problem]:
    """Writes converted scenarios back as the release's JSON files and split tables.

    Args:
        scenarios: as `read_release` made them, of any of the platforms.
        out: a new or empty folder.

    Returns:
        Files whose hash differs from the one in their split table.

    Raises:
        ScenarioError: the folder is not empty, or a scenario was not made from a release; nothing is written
            outside the folder, whatever a dataset's provenance says.
    """
    out = Path(out)
    changed = []
    tables: dict[str, list[tuple[int, Mapping[str, Any]]]] = {}
    with new_folder(out) as folder:
        for scenario in scenarios:
            data = to_json(scenario)
            number, note, row = _export_note(scenario)
            target = folder / row.path
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                with open(target, "xb") as file:
                    file.write(data)
            except OSError as err:
                raise ScenarioError(f"scenario {scenario.id}: {row.path} cannot be written: {err}") from None
            if hashlib.sha256(data).hexdigest() != row.cells["sha256"]:
                changed.append(
                    Problem(str(row.path), None, scenario.id, "its hash is not that of its split table")
                )
            tables.setdefault(table_name(scenario.platform, scenario.split), []).append((number, note))
        for name, rows in tables.items():
            rows.sort(key=lambda item: item[0])
            form = rows[0][1]["table"]
            target = folder / safe_path(name, "split table")
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(
                format_table([dict(n["split_row"]) for _, n in rows], form["newline"], form["bom"])
            )
    return changed


def _export_note(scenario: Scenario) -> tuple[int, Mapping[str, Any], SplitRow]:
    """Row number, provenance note and split row of a converted scenario, checked again: it may come from
    anyone."""
    note = scenario.provenance[KEY]
    try:
        number, cells, table = note["row"], note["split_row"], note["table"]
        good = type(number) is int and table["newline"] in ("\n", "\r\n") and type(table["bom"]) is bool
        good = (
            good and all(isinstance(c, str) for c in cells.values()) and set(cells) >= {"sample_id", "path"}
        )
        if not good:
            raise ValueError
        return number, note, check_row(number, dict(cells))
    except (KeyError, TypeError, AttributeError, ValueError) as err:
        detail = f": {err}" if isinstance(err, ScenarioError) else ""
        raise ScenarioError(
            f"scenario {scenario.id}, field provenance.{KEY}: not what the conversion of a release "
            f"writes{detail}; only converted scenarios can be exported"
        ) from None


def _usable_rows(tables: Sequence[SplitTable], result: Conversion) -> list[tuple[SplitTable, SplitRow]]:
    """Rows that are valid by themselves and whose id and file occur once in the release."""
    usable = []
    ids = Counter(cells["sample_id"] for table in tables for cells in table.rows)
    paths = Counter(cells["path"] for table in tables for cells in table.rows)
    splits: dict[str, set[str]] = {}
    for table in tables:
        for cells in table.rows:
            splits.setdefault(cells["sample_id"], set()).add(table.split)
    for table in tables:
        for number, cells in enumerate(table.rows, 1):
            try:
                row = check_row(number, cells)
                if len(splits[row.sample_id]) > 1:
                    raise ScenarioError(
                        f"column sample_id: {row.sample_id!r} is in train and in test; a test scenario that "
                        "was trained on measures nothing. Neither is converted: drop one of the rows"
                    )
                for column, found in (("sample_id", ids), ("path", paths)):
                    if found[cells[column]] > 1:
                        raise ScenarioError(
                            f"column {column}: {cells[column]!r} is in {found[cells[column]]} rows; none of "
                            "them is converted: keep one"
                        )
            except ScenarioError as err:
                result.failures.append(Problem(table.name, number, cells["sample_id"][:140], str(err)))
            else:
                usable.append((table, row))
    return usable


def _check_against_row(scenario: Scenario, row: SplitRow) -> None:
    """Checks that the split table and the record say the same.

    Raises:
        ScenarioError: names the column and both values.
    """
    note = scenario.provenance[KEY]
    record = note["record"]
    name = (
        f"{record['task_suite_name']}/{record['task_id']}"
        if scenario.platform == "libero"
        else record["task_name"]
    )
    for column, said in (
        ("actions", str(len(scenario.prefix) + len(note.get("tail", [])))),
        ("task_name", name),
        ("s_stage", record["s_stage"]),
        ("d_stage", record["d_stage"]),
    ):
        cell = str(int(row.cells[column])) if column == "actions" else row.cells[column]
        if cell != said:
            raise ScenarioError(
                f"column {column} of its split table (row {row.number}) says {row.cells[column]!r:.80}, the "
                f"record {said!r:.80}; the two are not of one release. Fetch it again"
            )


def _refuse_leaks(result: Conversion, hashes: Mapping[tuple[str, str], str]) -> None:
    """Takes out scenarios of train and test that are the same scenario under two ids."""
    by_content: dict[str, set[str]] = {}
    contents = {s.id: (hashes[(s.split, s.id)], s.sha256()) for s in result.scenarios}
    for scenario in result.scenarios:
        for digest in contents[scenario.id]:
            by_content.setdefault(digest, set()).add(scenario.split)
    kept = []
    for scenario in result.scenarios:
        if any(len(by_content[digest]) > 1 for digest in contents[scenario.id]):
            path = scenario.provenance[KEY]["split_row"]["path"]
            result.failures.append(
                Problem(
                    path,
                    None,
                    scenario.id,
                    "fields seed, episode_idx and actions: the same scenario is in train and in test under "
                    "another sample_id; neither is converted: drop one",
                )
            )
        else:
            kept.append(scenario)
    result.scenarios = kept


def _report_unlisted(root: Path, tables: Iterable[SplitTable], result: Conversion) -> None:
    listed = {cells["path"] for table in tables for cells in table.rows}
    for table in tables:
        folder = root / result.platform / table.split
        for path in sorted(folder.glob("*.json")):
            name = path.relative_to(root).as_posix()
            if name not in listed:
                result.failures.append(
                    Problem(
                        name,
                        None,
                        path.stem,
                        f"no row of {table.name} has it in column path; add its row, or remove the file",
                    )
                )


def _without_name(err: ScenarioError, name: str) -> str:
    """The message without the file's name at its start, which the problem carries already."""
    return str(err).removeprefix(f"{name} ").removeprefix(f"{name}: ")
