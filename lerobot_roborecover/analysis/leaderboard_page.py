"""The leaderboard as files: a static page and JSON."""

from __future__ import annotations

import importlib.resources
import json
from pathlib import Path

from lerobot_roborecover import __version__
from lerobot_roborecover.analysis import published
from lerobot_roborecover.analysis.leaderboard import Board, Entry, Leaderboard, as_json, ranks, separated
from lerobot_roborecover.analysis.tables import Column, Table
from lerobot_roborecover.whole import write_whole


def write_leaderboard(
    found: Leaderboard, out: Path, title: str = "Recovery leaderboard"
) -> tuple[Path, Path]:
    """Writes `index.html` and `leaderboard.json`.

    Args:
        found: what to show.
        out: folder; made if need be.
        title: heading of the page.
    """
    import jinja2

    folder = importlib.resources.files("lerobot_roborecover.analysis")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(folder.joinpath("leaderboard.html.j2").read_text("utf-8"))
    boards = [{"board": board, "table": board_table(board, n)} for n, board in enumerate(found.boards)]
    page = template.render(
        title=title, boards=boards, published=published_table(), refused=found.refused, version=__version__
    )
    files = out / "index.html", out / "leaderboard.json"
    for path, text in zip(files, (page, json.dumps(as_json(found), indent=1)), strict=True):
        write_whole(path, text)
    return files


def board_table(board: Board, number: int = 0) -> Table:
    """One board's entries."""
    rows = []
    for rank, entry in zip(ranks(board), board.entries, strict=True):
        numbers = (entry.macro, entry.initial, entry.scenarios, entry.trials, entry.invalid)
        standing, day = _standing(entry, rank), entry.provenance.finished_at[:10]
        rows.append((rank, entry.policy, entry.rsr, entry.behind, standing, *numbers, day))
    columns = (
        Column("Rank", "count"), Column("Policy"), Column("RSR %", "percent"),
        Column("Behind the best", "points"), Column("Standing"), Column("Macro %", "percent"),
        Column("Initial state %", "percent"), Column("Scenarios", "count"), Column("Trials", "count"),
        Column("Invalid", "count"), Column("Last trial"),
    )  # fmt: skip
    o = board.options
    notes = (
        f"[{100 * o.level:g} % intervals], {o.draws} bootstrap draws, seed {o.seed}; differences on "
        "the same draws, not "
        "adjusted for their number. Invalid trials count as failures. Incomplete entries lack "
        "scenarios that others "
        "were run on and have no rank; neither have interventions.",
    )
    return Table(f"board_{number}", f"{board.platform}: {board.dataset}", columns, tuple(rows), notes)


def _standing(entry: Entry, rank: str) -> str:
    if entry.interventions:
        return "intervention"
    if not rank:
        return "incomplete"
    if separated(entry):
        return "behind the best"
    return "best" if rank == "1" else "not separated from it"


def published_table() -> Table:
    """The paper's twelve rows, best first on each platform."""
    rows = [
        (r.platform, r.policy, r.rsr, r.macro9, r.initial)
        for r in sorted(published.policies(), key=lambda r: (r.platform, -r.rsr.value))
    ]
    columns = (
        Column("Platform"), Column("Policy"), Column("RSR %", "percent"), Column("Macro-9 %", "percent"),
        Column("Initial state %", "percent"),
    )  # fmt: skip
    notes = ("The paper's numbers on its own 200 test scenarios a platform; not re-run here.",)
    return Table("published", "Published results", columns, tuple(rows), notes)
