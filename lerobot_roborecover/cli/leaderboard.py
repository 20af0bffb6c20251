"""`roborecover leaderboard`."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.analysis.options import Options, ResamplingOptions
from lerobot_roborecover.utils.options import option

if TYPE_CHECKING:
    from lerobot_roborecover.analysis.leaderboard import Leaderboard

HELP = (
    "Make a leaderboard (a static page, JSON, a Space for the Hub) from all trial logs below a folder; offer "
    "one policy's results to its model on the Hub; compare with the Hub's board."
)


@dataclass(frozen=True, kw_only=True)
class SpaceOptions:
    """The Space that is written beside the page."""

    space: Path | None = option(None, metavar="DIR")
    """Also write a static Space: boards, scenarios, videos."""
    render: bool = False
    """Render recovery frames that the scenario sets do not hold."""
    videos: tuple[str, ...] = option((), metavar="NAME=DIR")
    """A policy's videos or .rrd recordings for the Space; may be given again (default: `videos/` beside each
    log)."""


@dataclass(frozen=True, kw_only=True)
class HubOptions:
    """What is offered to the Hub, and compared with it."""

    hub: str | None = option(None, metavar="ORG/MODEL")
    """Offer one policy's results to this model's repository as a pull request (.eval_results/*.yaml)."""
    policy: str | None = None
    """Whose results to offer, where there are several."""
    dataset_id: str | None = option(None, metavar="ORG/NAME")
    """The scenario set on the Hub, where the logs name a folder."""
    source: str | None = option(None, metavar="URL")
    """Where the trial log is published."""
    with_log: bool = False
    """Put the trial log into the pull request, as the source."""
    dry_run: bool = False
    """Show what would be offered, and offer nothing."""
    hub_board: str | None = option(None, metavar="ORG/SET")
    """Read this scenario set's results on the Hub, and compare them with the local ones."""


@dataclass(frozen=True, kw_only=True)
class LeaderboardOptions:
    """Which logs to rank, and what to make of them."""

    folder: Path = option(positional=True)
    """Folder of trial logs (*.jsonl), at any depth."""
    out: Path = Path("outputs/leaderboard")
    """Folder of the page."""
    title: str = "Recovery leaderboard"
    """Heading of the page."""
    resampling: ResamplingOptions = field(default_factory=ResamplingOptions)
    methods: tuple[str, ...] = option((), name="method", metavar="NAME=LOG,LOG")
    """Logs below the folder (or folders of them) that are the runs of one method; may be given again."""
    space: SpaceOptions = option(factory=SpaceOptions, group="a Space")
    hub: HubOptions = option(factory=HubOptions, group="results on the Hub")


OPTIONS = LeaderboardOptions


def run(options: LeaderboardOptions) -> int:
    """Writes the page; offers and compares where asked. 1 when some log could not be used."""
    from lerobot_roborecover.analysis.leaderboard import make_leaderboard
    from lerobot_roborecover.analysis.pages.leaderboard import board_table, write_leaderboard
    from lerobot_roborecover.analysis.tables import to_text

    found = make_leaderboard(options.folder, Options(**vars(options.resampling)), options.methods)
    page, data = write_leaderboard(found, options.out, options.title)
    for board in found.boards:
        table = board_table(board)
        print(f"{table.title}\n{to_text(table)}\n")
    for name, reason in found.refused:
        print(f"not used: {name}: {reason}")
    print(f"page      {page}\ndata      {data}")
    if options.space.space:
        _write_space(options.space, options.title, options.folder, found)
    if options.hub.hub:
        _offer(options.hub, options.folder, options.hub.hub, found)
    if options.hub.hub_board:
        from lerobot_roborecover.analysis.hub_board import comparison_table, read_board

        table = comparison_table(options.hub.hub_board, read_board(options.hub.hub_board), found)
        print(f"\n{table.title}\n{to_text(table)}")
    return int(bool(found.refused))


def _write_space(options: SpaceOptions, title: str, logs: Path, found: Leaderboard) -> None:
    from lerobot_roborecover.analysis.named_path import split_named
    from lerobot_roborecover.analysis.pages.space import SpaceConfig, write_space
    from lerobot_roborecover.logs.row import ACTIONS_FOLDER

    assert options.space is not None
    media = [(name, Path(folder)) for name, folder in map(split_named, options.videos)]
    actions = [folder for folder in sorted(logs.rglob(ACTIONS_FOLDER)) if folder.is_dir()]
    for remark in write_space(found, options.space, SpaceConfig(title, options.render, media, actions)):
        print(f"note: {remark}", file=sys.stderr)
    print(f"space     {options.space}: hf upload ORG/NAME {options.space} --repo-type space")


def _offer(options: HubOptions, folder: Path, model: str, found: Leaderboard) -> None:
    from lerobot_roborecover.analysis import hub_results
    from lerobot_roborecover.errors import OptionError

    if options.source and options.with_log:
        raise OptionError("--source and --with-log: a result has one source. Leave one of them out")
    board, entry = hub_results.find_entry(found, options.policy)
    logs = hub_results.log_files(folder, entry) if options.with_log else {}
    source = next((hub_results.file_address(model, path) for path in logs), options.source)
    path = hub_results.file_name(board)
    text = hub_results.results_yaml(board, entry, options.dataset_id, source)
    print(f"\n{path} in {model}:\n{text}")
    if source is None:
        print(
            "no source: --with-log puts the trial log beside the result, --source=URL names a published one"
        )
    if options.dry_run:
        print("dry run: nothing was offered")
        return
    print(f"offered   {hub_results.offer_results(model, {path: text.encode(), **logs})}")
