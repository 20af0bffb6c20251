"""A static Space for the Hub: the leaderboard, and of each board a gallery of its scenarios with videos."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.analysis.board import Board, BoardTrials
from lerobot_roborecover.analysis.leaderboard import Leaderboard
from lerobot_roborecover.analysis.pages.gallery import TrialVideo, check_scenarios, gallery_values, make_cards
from lerobot_roborecover.analysis.pages.leaderboard import BoardGallery, write_leaderboard
from lerobot_roborecover.analysis.pages.media import find_media, videos_beside
from lerobot_roborecover.analysis.pages.page import render_page
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.datasets.certificate import describe_certificate
from lerobot_roborecover.datasets.load import HUB_ID, ScenarioSet
from lerobot_roborecover.errors import RoboRecoverError
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.utils.atomic_io import atomic_file, atomic_write
from lerobot_roborecover.utils.outputs import claim_page


@dataclass(frozen=True)
class SpaceConfig:
    """What a Space shows beside the boards."""

    title: str = "Recovery leaderboard"
    render: bool = False
    """Render recovery frames that the scenario sets do not hold; runs the simulators."""
    media: Sequence[tuple[str, Path]] = ()
    """A policy's name and the folder of its videos or `.rrd` recordings; without any, `videos/` beside each
    log."""
    action_folders: Sequence[Path] = ()
    """Where actions of the trials were recorded."""


def write_space(found: Leaderboard, out: Path, config: SpaceConfig | None = None) -> list[str]:
    """Writes `README.md`, `index.html`, a page a board, and pictures and videos beside them.

    Args:
        found: the leaderboard.
        out: folder; made if need be. Files of other names in it stay.
        config: title, pictures, videos.

    Returns:
        Remarks: scenario sets that could not be loaded, pictures and videos that are missing.

    Raises:
        RowsError: a folder of videos does not exist.
        OutputExistsError: `out` holds files of these names that are of no earlier Space.
    """
    config = config or SpaceConfig()
    remarks: list[str] = []
    pages = [f"scenarios-{n + 1}.html" for n in range(len(found.boards))]
    beside = [pair for trials in found.trials for pair in trials.files.items()]
    rows: dict[str, list[TrialRow]] = {}
    for trials in found.trials:
        for policy, own in _rows_of(trials.recovery).items():
            rows.setdefault(policy, []).extend(own)
    media = list(enumerate(config.media or videos_beside(beside, rows=rows)))
    with claim_page(out, ["index.html", "leaderboard.json", "README.md", *pages]):
        galleries = []
        for board, trials, name in zip(found.boards, found.trials, pages, strict=True):
            frames, certificate, problems = _frames(board, trials, out, config.render)
            given = config.media or videos_beside(trials.files.items(), rows=_rows_of(trials.recovery))
            own = [(n, one) for n, one in media if one in given and one[0] in trials.recovery.arms]
            clips = _media(own, trials.recovery, out)
            cards = make_cards(
                trials.recovery, frames, clips, trials.initial, action_folders=config.action_folders
            )
            galleries.append(BoardGallery(name, cards))
            page = render_page(
                "gallery_page.html.j2",
                title=f"{config.title}: {board.platform}, {board.dataset}",
                scripts=("gallery.js", "trial.js"),
                with_files=True,
                board=board,
                certificate=certificate,
                **gallery_values(cards),
            )
            atomic_write(out / name, page)
            remarks += [f"{board.dataset}: {problem}" for problem in problems]
        write_leaderboard(found, out, config.title, galleries)
        used = {policy for policy, _ in config.media}
        policies = {arm for trials in found.trials for arm in trials.recovery.arms}
        if used - policies:
            remarks.append(
                f"videos of {', '.join(sorted(used - policies))}: no policy of these logs is called so; "
                f"there are {', '.join(sorted(policies))}"
            )
        atomic_write(out / "README.md", _card(config.title, found))
        return remarks


def _rows_of(panel: Panel) -> dict[str, list[TrialRow]]:
    """Rows by the title of their arm."""
    found: dict[str, list[TrialRow]] = {}
    for (arm, _), rows in panel.rows.items():
        found.setdefault(panel.arms[arm], []).extend(rows)
    return found


def _frames(
    board: Board, trials: BoardTrials, out: Path, render: bool
) -> tuple[dict[str, bytes | str], str, list[str]]:
    """Paths of recovery frames from the page, by scenario id; the set's certificate; and what is missing."""
    wanted = {s.id for s in trials.recovery.scenarios}
    try:
        found = _scenarios(board, trials.recovery.rows.values())
    except RoboRecoverError as err:
        return {}, "", [f"no pictures: {err}"]
    chosen = [s for s in found if s.id in wanted]
    certificate = describe_certificate(found.root) if found.root else ""
    files: dict[str, bytes | str] = {}
    folder = f"frames/{board.scenario_set}"
    for scenario in chosen:
        if scenario.fingerprint and scenario.fingerprint.frames_png:
            path = f"{folder}/{scenario.id}.png"
            atomic_write(out / path, scenario.fingerprint.frames_png[-1])
            files[scenario.id] = path
    todo = [s for s in chosen if s.id not in files]
    if not todo:
        return files, certificate, []
    if not render:
        return files, certificate, [f"{len(todo)} scenarios have no picture in the set; --render makes them"]
    from lerobot_roborecover.analysis.pages.pictures import render_frames

    made, problem = render_frames(todo, out / folder)
    files |= {scenario_id: f"{folder}/{path.name}" for scenario_id, path in made.items()}
    return files, certificate, [f"pictures are missing: {problem}"] if problem else []


def _scenarios(board: Board, rows: Iterable[Sequence[TrialRow]]) -> ScenarioSet:
    """The board's scenario set, which must be what the trials were made on."""
    from lerobot_roborecover.datasets import load_scenarios

    first = board.entries[0].provenance
    found = load_scenarios(first.dataset, revision=first.dataset_revision)
    check_scenarios((row for trials in rows for row in trials), list(found), first.dataset)
    return found


def _media(
    folders: Sequence[tuple[int, tuple[str, Path]]], panel: Panel, out: Path
) -> dict[str, list[TrialVideo]]:
    """Copies numbered folders of videos and recordings of a board's policies beside the page."""
    ids = [s.id for s in panel.scenarios]
    clips: dict[str, list[TrialVideo]] = {}
    for number, (policy, folder) in folders:
        name = re.sub(r"[^A-Za-z0-9]+", "-", policy).strip("-").lower()
        for scenario_id, ((trial, path), *_) in find_media(folder, ids).items():
            target = f"media/{number}-{name}/{scenario_id}{path.suffix}"
            (out / target).parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(out / target) as fresh:
                shutil.copyfile(path, fresh)
            clips.setdefault(scenario_id, []).append(TrialVideo(policy, target, trial))
    return clips


def _card(title: str, found: Leaderboard) -> str:
    """The Space's `README.md`, whose front matter the Hub reads."""
    import yaml

    named = {entry.provenance.dataset for board in found.boards for entry in board.entries}
    datasets = sorted(name for name in named if HUB_ID.fullmatch(name))
    front = {
        "title": title[:60],
        "emoji": "🦾",
        "colorFrom": "blue",
        "colorTo": "gray",
        "sdk": "static",
        "app_file": "index.html",
        "pinned": False,
        "tags": ["leaderboard", "robotics", "LeRobot", "RoboRecover"],
        **({"datasets": datasets} if datasets else {}),
    }
    text = yaml.safe_dump(front, sort_keys=False, allow_unicode=True)
    return (
        f"---\n{text}---\n\nSuccess of robot policies from recovery points. Made from trial logs by "
        "`roborecover leaderboard --space`; nothing runs here.\n"
    )
