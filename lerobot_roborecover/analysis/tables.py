"""Tables: one content, four forms (Markdown, CSV, LaTeX, and cells for the HTML page)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from lerobot_roborecover.analysis.escape import csv_text, latex, markdown
from lerobot_roborecover.analysis.stats.estimators import UNDERPOWERED_BELOW
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.utils.text import align

Kind = Literal["text", "percent", "points", "ratio", "count", "number", "p"]
Cell = str | int | float | Estimate | None
"""None is an empty cell; NaN is an undefined number and is shown as n/a with a note."""

LATEX_COLUMNS = 6
"""Columns of a LaTeX table, at most: more do not fit a paper of two columns."""
LATEX_CHARACTERS = 46
"""Of a row that fits one column of such a paper, in small print."""
NOT_DEFINED = "n/a"
UNDEFINED_NOTE = (
    f"{NOT_DEFINED}: not defined, because there are no such trials, fewer than two scenarios to "
    "resample, too few "
    "trials per scenario, or nothing to divide by."
)
SPARSE_MARK = " *"
SPARSE_NOTE = f"* fewer than {UNDERPOWERED_BELOW} scenarios: neither rate nor interval says much."


@dataclass(frozen=True)
class Column:
    """A column's heading and how its values are to be read."""

    title: str
    kind: Kind = "text"
    """`percent` and `points` show values in [0, 1] times 100; `p` is a p-value; `number` has one decimal."""


@dataclass(frozen=True)
class Table:
    """A table with its notes."""

    name: str
    """File name without ending."""
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()
    sparse: frozenset[int] = frozenset()
    """Rows over too few scenarios: marked and de-emphasised, never hidden."""

    def __post_init__(self):
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"table {self.name}: a row has {len(row)} cells for {len(self.columns)} columns"
                )

    def shown(self) -> Table:
        """Returns the table for readers: without columns that are undefined in every row, which a note names.
        CSV and JSON have all columns."""
        empty = [
            i
            for i in range(1, len(self.columns))
            if self.rows and all(_undefined(row[i]) for row in self.rows)
        ]
        if not empty:
            return self
        names = ", ".join(self.columns[i].title for i in empty)
        keep = [i for i in range(len(self.columns)) if i not in empty]
        return replace(
            self,
            columns=tuple(self.columns[i] for i in keep),
            rows=tuple(tuple(row[i] for i in keep) for row in self.rows),
            notes=(*self.notes, f"Not shown, because not defined here: {names}."),
        )

    def all_notes(self) -> list[str]:
        """Its own notes and those that its values call for."""
        notes = list(self.notes)
        if self.sparse:
            notes.append(SPARSE_NOTE)
        if any(NOT_DEFINED in text for row in self.texts() for text in row):
            notes.append(UNDEFINED_NOTE)
        return notes

    def texts(self) -> Iterator[list[str]]:
        """Rows as text."""
        for index, row in enumerate(self.rows):
            cells = [cell_text(value, column) for value, column in zip(row, self.columns, strict=True)]
            if index in self.sparse:
                cells[0] += SPARSE_MARK
            yield cells


def _undefined(value: Cell) -> bool:
    number = value.value if isinstance(value, Estimate) else value
    return isinstance(number, float) and math.isnan(number)


def cell_text(value: Cell, column: Column) -> str:
    """One cell in words and figures."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    if isinstance(value, Estimate):
        bounds = NOT_DEFINED
        if not math.isnan(value.low):
            bounds = f"{_number(value.low, column.kind)}, {_number(value.high, column.kind)}"
        shown = _number(value.value, column.kind)
        return shown if shown == NOT_DEFINED else f"{shown} [{bounds}]"
    return _number(value, column.kind)


def _number(value: float, kind: Kind) -> str:
    if math.isnan(value):
        return NOT_DEFINED
    if kind in ("percent", "points"):
        text = f"{100 * value:.1f}"
        return "0.0" if text == "-0.0" else text
    if kind == "ratio":
        return f"{value:.2f}"
    if kind == "p":
        return f"{value:.4f}" if value >= 0.0001 else "<0.0001"
    if kind == "count":
        return str(int(value))
    return f"{value:.1f}"


def to_markdown(table: Table) -> str:
    """GitHub-flavoured Markdown: heading, table, notes."""
    table = table.shown()
    head = [column.title for column in table.columns]
    rule = ["---" if column.kind == "text" else "---:" for column in table.columns]
    lines = [f"## {markdown(table.title, cell=True)}", ""]
    lines += [
        f"| {' | '.join(markdown(c, cell=True) for c in cells)} |" for cells in (head, rule, *table.texts())
    ]
    lines += [f"\n{markdown(note)}" for note in table.all_notes()]
    return "\n".join(lines) + "\n"


def to_csv(table: Table) -> str:
    """CSV with one number a field: an estimate becomes three columns, rates stay in [0, 1]."""
    split = [any(isinstance(row[i], Estimate) for row in table.rows) for i in range(len(table.columns))]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    head: list[str] = []
    for column, wide in zip(table.columns, split, strict=True):
        head += [column.title, f"{column.title} low", f"{column.title} high"] if wide else [column.title]
    head = [csv_text(title) for title in head]
    writer.writerow([*head, "few scenarios"] if table.sparse else head)
    for index, row in enumerate(table.rows):
        fields: list[str] = []
        for value, wide in zip(row, split, strict=True):
            fields += _csv_fields(value, wide)
        writer.writerow([*fields, "yes" if index in table.sparse else "no"] if table.sparse else fields)
    return stream.getvalue()


def _csv_fields(value: Cell, wide: bool) -> list[str]:
    if isinstance(value, Estimate):
        return [_csv_number(v) for v in (value.value, value.low, value.high)]
    is_text = value is None or isinstance(value, str)
    text = csv_text(value or "") if is_text else _csv_number(value)
    return [text, "", ""] if wide else [text]


def _csv_number(value: float) -> str:
    return NOT_DEFINED if math.isnan(value) else f"{value:.10g}"


def to_latex(table: Table) -> str:
    """A float with booktabs rules: blocks of at most `LATEX_COLUMNS` columns below each other, each with the
    first column, in a paper's one column where they fit and across both where they do not."""
    table = table.shown()
    rest = range(1, len(table.columns))
    blocks = [rest[k : k + LATEX_COLUMNS - 1] for k in range(0, len(rest), LATEX_COLUMNS - 1)] or [rest]
    texts = [[column.title for column in table.columns], *table.texts()]
    widths = [max(len(row[i]) for row in texts[1:] or texts) for i in range(len(table.columns))]
    wide = max(widths[0] + sum(widths[i] + 2 for i in block) for block in blocks) > LATEX_CHARACTERS
    environment = "table*" if wide else "table"
    caption = " ".join([f"{table.title}.", *table.all_notes()])
    lines = [
        rf"\begin{{{environment}}}[t]",
        r"\centering",
        r"\small",
        "\n\\par\\medskip\n".join(_latex_block(table, texts, (0, *block)) for block in blocks),
        rf"\caption{{{latex(caption)}}}",
        rf"\label{{tab:roborecover-{table.name.replace('_', '-')}}}",
        rf"\end{{{environment}}}",
    ]
    return "\n".join(lines) + "\n"


def _latex_block(table: Table, texts: Sequence[Sequence[str]], columns: Sequence[int]) -> str:
    shape = "".join("l" if table.columns[i].kind == "text" else "r" for i in columns)
    head, *rows = [" & ".join(latex(row[i]) for i in columns) + r" \\" for row in texts]
    rules = r"\toprule", head, r"\midrule", *rows, r"\bottomrule"
    return "\n".join((rf"\begin{{tabular}}{{{shape}}}", *rules, r"\end{tabular}"))


def to_text(table: Table) -> str:
    """Plain text for a terminal: aligned columns and notes."""
    table = table.shown()
    rows = [[column.title for column in table.columns], *table.texts()]
    left = [i for i, column in enumerate(table.columns) if column.kind == "text"]
    return "\n".join([*align(rows, left), *table.all_notes()])
