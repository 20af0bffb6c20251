"""A whole release as scenarios: membership, hashes and leakage checked; what fails is reported, the rest goes
on."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from lerobot_roborecover.datasets.release.fields import RequiresOptIn, check_labels
from lerobot_roborecover.datasets.release.json_form import KEY
from lerobot_roborecover.datasets.release.record import RULES, Reading, to_scenario
from lerobot_roborecover.datasets.release.tables import (
    MAX_RECORD_BYTES,
    PLATFORMS,
    SPLITS,
    SplitRow,
    SplitTable,
    check_row,
    find_tables,
    read_file,
    read_table,
    table_name,
)
from lerobot_roborecover.datasets.schema import check_limits
from lerobot_roborecover.scenario import Scenario, ScenarioError

_AS_RELEASED = (
    "The file has the hash of its table, so that fetching it again changes nothing: tell those who published "
    "the release"
)


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


def platforms_of(root: Path, tables: Path | None = None) -> list[str]:
    """The platforms for which a release has a split table; arguments as of `read_release`."""
    folder = find_tables(tables or root)
    return [p for p in PLATFORMS if any((folder / f"{p}_{s}.csv").exists() for s in SPLITS)]


def read_release(
    root: str | os.PathLike[str],
    platform: str,
    *,
    tables: str | os.PathLike[str] | None = None,
    reading: Reading = RULES,
) -> Conversion:
    """Reads every record of one platform.

    Args:
        root: the folder that holds `libero/` and `robotwin/`.
        platform: `libero` or `robotwin`.
        tables: the folder of the split tables, or the one that holds `splits/`; `root` by default. The tables
            lie in the release's git repository, the records in an archive.
        reading: what is taken.

    Raises:
        ScenarioError: there is no split table, one is no table of the release format, or none of the files is
            there. A bad record raises nothing: it is among the failures.
    """
    root = Path(root)
    result = Conversion(platform)
    folder = find_tables(Path(tables) if tables else root)
    found = [t for t in (read_table(folder, platform, s) for s in SPLITS) if t is not None]
    if not found:
        raise ScenarioError(
            f"{tables or root} has no {table_name(platform, 'train')} or {table_name(platform, 'test')}. "
            "Name the release's folder, the one that holds splits/; where the tables lie apart from the "
            "data, in the git clone, name that with --splits. JSON files are converted without a table when "
            "they are named themselves"
        )
    hashes: dict[tuple[str, str], str] = {}
    rows = _usable_rows(found, result)
    if rows and not any((root / row.path).exists() for _, row in rows):
        raise ScenarioError(
            f"{root} has none of the {len(rows)} files that its tables name, such as {rows[0][1].path}. The "
            "records are an archive apart from the git clone: unpack it, name its folder (the one that holds "
            f"{rows[0][1].path.parts[0]}/), and the tables' with --splits"
        )
    for table, row in rows:
        name = str(row.path)
        try:
            data = read_file(root, row.path, MAX_RECORD_BYTES)
            digest = hashlib.sha256(data).hexdigest()
            if digest != row.cells["sha256"]:
                raise ScenarioError(
                    f"SHA-256 is {digest}, {table.name} (row {row.number}, column sha256) says "
                    f"{row.cells['sha256']}: the file is not the one that was released. Fetch it again"
                )
            scenario = read_record(platform, data, table, row, reading, _AS_RELEASED)
        except ScenarioError as err:
            result.failures.append(Problem(name, None, row.sample_id, _without_name(err, name)))
            continue
        result.scenarios.append(scenario)
        hashes[(table.split, row.sample_id)] = digest
    _refuse_leaks(result, hashes)
    _report_unlisted(root, found, result)
    warn_of_instructions(result)
    for table in found:
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


def read_record(
    platform: str, data: bytes, table: SplitTable, row: SplitRow, reading: Reading, remedy: str
) -> Scenario:
    """One record with its row as a scenario, checked against the row.

    Args:
        platform: `libero` or `robotwin`.
        data: the file's bytes.
        table: that has the row.
        row: says id, split and prefix.
        reading: what is taken.
        remedy: what the user who downloaded the file can do about a bad record.

    Raises:
        ScenarioError: names the field, the value, and the remedy.
    """
    try:
        scenario = to_scenario(
            platform,
            data,
            split=table.split,
            sample_id=row.sample_id,
            prefix_steps=row.replay_prefix_steps,
            reading=reading,
        )
        check_limits(scenario)
    except RequiresOptIn:
        raise
    except ScenarioError as err:
        raise ScenarioError(f"{err}. {remedy}") from None
    _check_against_row(scenario, row)
    try:
        check_labels(scenario.provenance[KEY]["record"])
    except ScenarioError as err:
        raise ScenarioError(f"{err}. {remedy}") from None
    note = {
        **scenario.provenance[KEY],
        "split_row": row.cells,
        "row": row.number,
        "table": {"newline": table.newline, "bom": table.bom},
    }
    scenario = replace(scenario, provenance={KEY: note})
    check_limits(scenario)
    return scenario


def warn_of_instructions(result: Conversion) -> None:
    """Says where policies are prompted with other words than a record's `task_description`."""
    others: dict[tuple[str, str, str], list[Scenario]] = {}
    for scenario in result.scenarios:
        said = scenario.provenance[KEY]["record"]["task_description"]
        # RoboTwin's record has an instruction of its own, which its evaluators prompt with.
        if scenario.platform == "libero" and said != scenario.task.instruction:
            name = scenario.provenance[KEY]["split_row"]["task_name"]
            others.setdefault((name, said, scenario.task.instruction), []).append(scenario)
    for (name, said, prompt), scenarios in sorted(others.items()):
        result.warnings.append(
            Problem(
                scenarios[0].provenance[KEY]["split_row"]["path"],
                None,
                scenarios[0].id,
                f"field task_description of {len(scenarios)} record(s) of {name}: {said!r:.200}; policies "
                f"are prompted with LIBERO's own {prompt!r}, as the paper's evaluators do. Both are kept",
            )
        )


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
                result.failures.append(Problem(table.name, number, cells["sample_id"][:255], str(err)))
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
