"""Writes what forks gained: tables, picture and one page."""

from __future__ import annotations

from pathlib import Path

from lerobot_roborecover.analysis.figures.fork_gain import gain_by_step
from lerobot_roborecover.analysis.figures.style import render
from lerobot_roborecover.analysis.fork_tables import gain_tables
from lerobot_roborecover.analysis.pages.page import picture, render_page
from lerobot_roborecover.analysis.stats.fork_gain import ForkGains
from lerobot_roborecover.analysis.tables import Table, to_csv, to_markdown
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.outputs import claim_page

PAGE = "gain.html"


def write_gains(gains: ForkGains, out: Path, command: str) -> list[Table]:
    """Writes `gain.html`, `gain.md`, a CSV file of each table, and `fork_gain.svg` and `.png`.

    Args:
        gains: of the log.
        out: folder.
        command: that made the forks.

    Returns:
        The tables.
    """
    tables, figure = gain_tables(gains), gain_by_step(gains)
    with claim_page(out, (PAGE, "gain.md", "fork_gain.svg", "fork_gain.png")):
        svg, png = render(figure)
        atomic_write(out / "fork_gain.svg", svg)
        atomic_write(out / "fork_gain.png", png)
        for table in tables:
            atomic_write(out / f"{table.name}.csv", to_csv(table))
        atomic_write(out / "gain.md", "\n".join(map(to_markdown, tables)))
        about = {"Made by": command, "Exactness": reproduced_text(gains)}
        page = render_page(
            "tables_figures.html.j2", title="Forks", about=about, pictures=[picture(figure)], tables=tables
        )
        atomic_write(out / PAGE, page)
        return tables


def reproduced_text(gains: ForkGains) -> str:
    """Whether continuing gave the logged trials' rest."""
    same, of = gains.reproduced
    return (
        f"Continued from their middle to check, {same} of {of} logged trials end as they did, action for "
        "action."
    )
