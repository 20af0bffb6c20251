"""The release's split tables: `splits/<platform>_<split>.csv`, one row a scenario file.

Nothing in a row is trusted: a path must stay inside the release, a hash must be one, a count must be a count.
"""

from __future__ import annotations

import csv
import io
import re
import stat
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from lerobot_roborecover.scenario import ID_RULE, ScenarioError, is_id, shown_id

SPLITS = ("train", "test")
PLATFORMS = ("libero", "robotwin")
COLUMNS = (
    "sample_id",
    "path",
    "sha256",
    "original_sha256",
    "actions",
    "replay_prefix_steps",
    "task_name",
    "s_stage",
    "d_stage",
)
MAX_TABLE_BYTES = 2**26
MAX_RECORD_BYTES = 2**24

_HASH = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class SplitRow:
    """One row of a split table, checked."""

    number: int
    """Row in its table, counted from 1 below the header."""
    cells: dict[str, str]
    """The row as it stands, by column."""
    path: PurePosixPath
    """The scenario's file below the release's root: relative, without `..`."""
    actions: int
    """Actions that the file holds."""
    replay_prefix_steps: int
    """How many of them are replayed to reach the recovery point."""

    @property
    def sample_id(self) -> str:
        return self.cells["sample_id"]


@dataclass(frozen=True)
class SplitTable:
    """A split table and how it was written."""

    name: str
    """Path below the release's root."""
    split: str
    rows: list[dict[str, str]]
    """Cells by column, unchecked."""
    newline: str
    bom: bool
    reproducible: bool
    """Whether `format_table` gives the file's bytes back."""


def table_name(platform: str, split: str) -> str:
    """Path of a split table below the release's root."""
    return f"splits/{platform}_{split}.csv"


def find_tables(root: Path) -> Path:
    """The folder that holds the split tables: `splits` below `root`, or `root` where that is named itself."""
    given = [root / PurePosixPath(table_name(p, s)).name for p in PLATFORMS for s in SPLITS]
    inside = not (root / "splits").is_dir() and any(path.is_file() for path in given)
    return root if inside else root / "splits"


def read_table(folder: Path, platform: str, split: str) -> SplitTable | None:
    """Reads a split table; None where there is none for this platform and split.

    Args:
        folder: of the tables, as `find_tables` gives it.
        platform: `libero` or `robotwin`.
        split: `train` or `test`.

    Raises:
        ScenarioError: the file is no CSV of the release's columns.
    """
    name = table_name(platform, split)
    file = PurePosixPath(name).name
    if not (folder / file).exists() and not (folder / file).is_symlink():
        return None
    data = read_file(folder, PurePosixPath(file), MAX_TABLE_BYTES)
    bom = data.startswith(b"\xef\xbb\xbf")
    try:
        text = data.decode("utf-8-sig")
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        lines = [line for line in reader if line]
    except (UnicodeDecodeError, csv.Error) as err:
        raise ScenarioError(f"{name} is not a CSV table in UTF-8 ({err}); fetch the release again") from None
    header = lines[0] if lines else []
    missing = [c for c in COLUMNS if c not in header]
    extra = [c for c in header if c not in COLUMNS]
    if missing or extra or len(header) != len(COLUMNS):
        raise ScenarioError(
            f"{name}, header: missing columns {missing}, unknown columns {str(extra)[:200]}; the release "
            f"format has each of {', '.join(COLUMNS)} once"
        )
    for number, line in enumerate(lines[1:], 1):
        if len(line) != len(header):
            raise ScenarioError(
                f"{name}, row {number}: {len(line)} cells, the header has {len(header)}; fetch the release "
                "again"
            )
    rows = [dict(zip(header, line, strict=True)) for line in lines[1:]]
    newline = "\r\n" if "\r\n" in text else "\n"
    same = format_table(rows, newline, bom) == data
    return SplitTable(name, split, rows, newline, bom, same)


def format_table(rows: list[dict[str, str]], newline: str, bom: bool) -> bytes:
    """A split table as bytes; `rows` are cells by column, in the order of the header."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator=newline)
    writer.writerow(rows[0] if rows else COLUMNS)
    writer.writerows(row.values() for row in rows)
    return out.getvalue().encode("utf-8-sig" if bom else "utf-8")


def check_row(number: int, cells: dict[str, str]) -> SplitRow:
    """Checks one row of a table by itself.

    Raises:
        ScenarioError: names the column, the value and what it must be.
    """
    if not is_id(cells["sample_id"]):
        raise ScenarioError(
            f"column sample_id: {shown_id(cells['sample_id'])} is not {ID_RULE}; rename the sample"
        )
    for column in ("sha256", "original_sha256"):
        if not _HASH.fullmatch(cells[column]) and (column == "sha256" or cells[column]):
            raise ScenarioError(f"column {column}: {cells[column]!r:.80} is not a SHA-256 in lower-case hex")
    for column in ("actions", "replay_prefix_steps"):
        if not re.fullmatch(r"[0-9]{1,6}", cells[column]):
            raise ScenarioError(f"column {column}: {cells[column]!r:.80} is not a count")
    row = SplitRow(
        number,
        cells,
        safe_path(cells["path"], "column path"),
        int(cells["actions"]),
        int(cells["replay_prefix_steps"]),
    )
    if not 1 <= row.replay_prefix_steps <= row.actions:
        raise ScenarioError(
            f"column replay_prefix_steps: {row.replay_prefix_steps} is not from 1 to actions = {row.actions};"
            " a prefix is never padded"
        )
    return row


def safe_path(text: str, where: str) -> PurePosixPath:
    """A relative path that names a file below a root, on every system.

    Raises:
        ScenarioError: it is absolute, leaves the root, or holds characters that a system gives a meaning of
            their own.
    """
    path = PurePosixPath(text)
    plain = text.isprintable() and not set(text) & set('\\:*?"<>|') and str(path) == text
    if not plain or path.is_absolute() or ".." in path.parts or not 0 < len(path.parts) <= 8:
        raise ScenarioError(
            f"{where}: {text!r:.120} is not a plain relative path inside the release; nothing outside its "
            "folder is read or written"
        )
    return path


def read_file(root: Path, path: PurePosixPath, limit: int) -> bytes:
    """The bytes of one regular file inside the release.

    Its first two folders may be links to wherever the data was unpacked (`libero`, `libero/test`): those a
    user makes. A link of the file itself, or of a folder further down, may not lead out of them.

    Raises:
        ScenarioError: it is missing, leads out of the release, is no regular file, or is too large.
    """
    try:
        real = (root / path).resolve(strict=True)
        if not real.is_relative_to(root.joinpath(*path.parent.parts[:2]).resolve()):
            raise ScenarioError(
                f"{path} is a link that leaves the release, to {real}; link its folder, or put the file "
                "itself there"
            )
        status = real.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > limit:
            raise ScenarioError(
                f"{path} is not a regular file of at most {limit} bytes ({status.st_size} bytes)"
            )
        return real.read_bytes()
    except FileNotFoundError:
        raise ScenarioError(f"{path} does not exist; fetch the release again, or drop its row") from None
    except (OSError, RuntimeError) as err:
        raise ScenarioError(f"{path} cannot be read: {err}. Check its permissions and links") from None
