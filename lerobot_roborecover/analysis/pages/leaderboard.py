"""The leaderboard as files: a static page and JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

from lerobot_roborecover.analysis import published
from lerobot_roborecover.analysis.board import Board, Entry, ranks, separated
from lerobot_roborecover.analysis.leaderboard import Leaderboard, as_json
from lerobot_roborecover.analysis.pages.page import render_page
from lerobot_roborecover.analysis.stats.macro import MACRO_9
from lerobot_roborecover.analysis.stats.verdicts import ComparisonVerdict
from lerobot_roborecover.analysis.tables import Column, Table
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.outputs import claim_page


def write_leaderboard(
    found: Leaderboard, out: Path, title: str = "Recovery leaderboard", galleries: Sequence[str] = ()
) -> tuple[Path, Path]:
    """Writes `index.html` and `leaderboard.json`.

    Args:
        found: what to show.
        out: folder; made if need be.
        title: heading of the page.
        galleries: pages of the boards' scenarios, beside this one, where there are some.
    """
    boards = [
        {
            "board": board,
            "table": board_table(board, n),
            "published": published_table(board.platform),
            "gallery": galleries[n] if galleries else "",
        }
        for n, board in enumerate(found.boards)
    ]
    page = render_page("leaderboard.html.j2", title=title, boards=boards, refused=found.refused)
    files = out / "index.html", out / "leaderboard.json"
    with claim_page(out, [path.name for path in files]):
        for path, text in zip(files, (page, json.dumps(as_json(found), indent=1)), strict=True):
            atomic_write(path, text)
        return files


def board_table(board: Board, number: int = 0) -> Table:
    rows, several = [], any(entry.runs > 1 for entry in board.entries)
    own_macro = bool(board.cells.counted) and not board.cells.is_macro_9
    for rank, entry in zip(ranks(board), board.entries, strict=True):
        macro = (entry.macro, entry.macro9) if own_macro else (entry.macro9,)
        numbers = (*macro, entry.initial, entry.scenarios, entry.trials, entry.invalid)
        standing, day = _standing(entry, rank), entry.provenance.finished_at[:10]
        runs = (entry.runs, entry.other_runs, entry.run_sd) if several else ()
        rows.append((entry.policy, rank, entry.rsr, *runs, entry.behind, standing, *numbers, day))
    columns = (
        Column("Policy"), Column("Rank"), Column("RSR %", "percent"),
        *((Column("Runs", "count"), Column("RSR %, runs like these", "percent"),
        Column("SD between runs", "points")) if several else ()),
        Column("Behind the best", "points"), Column("Standing"),
        *((Column(f"{board.cells.title} %", "percent"),) if own_macro else ()),
        Column(f"{MACRO_9} %", "percent"),
        Column("Initial state %", "percent"), Column("Scenarios", "count"), Column("Trials", "count"),
        Column("Invalid", "count"), Column("Last trial"),
    )  # fmt: skip
    o = board.options
    notes = (
        f"[{100 * o.level:g} % intervals] over {board.unit}, those of differences not adjusted for their "
        f"number. Standing and rank follow Holm's p of the sign-flip test, at {1 - o.level:.3g} for all "
        "pairs of complete entries; a rank is what these leave open. Invalid trials count as failures. "
        "Incomplete entries lack scenarios of the set and have no rank; neither have interventions.",
        f"Scenario set {board.scenario_set} ({board.scenarios} scenarios), by content: other sets are other "
        "boards.",
        *board.cells.notes(board.unit),
        *((_OF_RUNS,) if several else ()),
    )
    title = f"{board.platform}: {board.dataset}, set {board.scenario_set}"
    return Table(f"board_{number}", title, columns, tuple(rows), notes)


_OF_RUNS = (
    "A method's RSR is the mean of its runs, and rank and standing are said of these runs. Runs like these: "
    "the interval with the variance between runs, which speaks of the method."
)


def _standing(entry: Entry, rank: str) -> str:
    if entry.interventions:
        return "intervention"
    if entry.stopped:
        return "stopped early"
    if math.isnan(entry.rsr.value):
        return "no valid trial"
    if not rank:
        return f"incomplete: {entry.missing}" if entry.missing else "incomplete"
    if entry.verdict is None:
        return "best"
    if separated(entry):
        return "behind the best"
    if entry.verdict in (ComparisonVerdict.COUNTS_DEPEND, ComparisonVerdict.NO_VALID_TRIAL):
        return entry.verdict.value
    return (
        "no verdict: too few differ"
        if entry.verdict is ComparisonVerdict.TOO_FEW
        else "not separated from it"
    )


def published_table(platform: str) -> Table | None:
    """The paper's rows of one platform, best first; None where it has none."""
    rows = [
        (r.policy, r.rsr, r.macro9, r.initial)
        for r in sorted(published.policies(platform), key=lambda r: -r.rsr.value)
    ]
    if not rows:
        return None
    columns = (
        Column("Policy"), Column("RSR %", "percent"), Column("Macro-9 %", "percent"),
        Column("Initial state %", "percent"),
    )  # fmt: skip
    notes = (f"The paper's numbers on its own 200 test scenarios of {platform}; not re-run here.",)
    return Table(f"published_{platform}", "Published results", columns, tuple(rows), notes)
