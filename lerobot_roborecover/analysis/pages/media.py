"""Videos and recordings of trials, found by the names that the commands give them."""

from __future__ import annotations

import base64
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from lerobot_roborecover.analysis.pages.gallery import TrialVideo
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.logs.log_file import videos_of_run
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.scenario import Start

_OF_A_FOLDER = ("eval_episode_0.mp4", "replay.rrd")
"""Files that are called alike for all scenarios: the folder names the scenario."""
TRIALS_SHOWN = 2
"""Of a policy on a scenario: two trials from one recovery point can be compared, more make a page heavy."""
_HASH = re.compile(r"[0-9a-f]{16}")
"""A protocol's hash; a log may say anything."""
_TRIAL = re.compile(r"(?P<id>.+)_trial(?P<trial>\d+)(_\w+)?")


def videos_beside(
    logs: Iterable[tuple[str, Path]],
    starts: Mapping[str, Start] | None = None,
    rows: Mapping[str, Iterable[TrialRow]] | None = None,
) -> list[tuple[str, Path]]:
    """Folders of the videos that an evaluation left beside its logs: those of its own protocol (`evaluate`),
    else `videos` (`roborecover eval`, `lerobot-eval`).

    A folder `videos` that several arms of one start share is left out: the names of its videos do not tell
    arms apart.

    Args:
        logs: title of each arm and its log.
        starts: of the arms' trials, by title; by default recovery points.
        rows: of the arms, by title, which say their protocols.

    Returns:
        Title and folder of each arm that has videos.
    """
    starts, found, shared = starts or {}, [], {}
    for arm, log in logs:
        hashes = dict.fromkeys(row.config_hash for row in (rows or {}).get(arm, ()))
        own = [videos_of_run(log, h) for h in hashes if _HASH.fullmatch(h) and videos_of_run(log, h).is_dir()]
        found += [(arm, folder) for folder in own]
        if not own:
            shared[arm, log.parent / "videos"] = None
    owners = Counter((folder, starts.get(arm, Start.RECOVERY)) for arm, folder in shared)
    return found + [
        (arm, folder)
        for arm, folder in shared
        if folder.is_dir() and owners[folder, starts.get(arm, Start.RECOVERY)] == 1
    ]


def find_media(
    folder: Path, ids: Sequence[str], start: Start = Start.RECOVERY
) -> dict[str, list[tuple[int, Path]]]:
    """Videos and recordings of each scenario, with the numbers of their trials, in that order.

    Taken are `<group>_<scenario>/eval_episode_0.mp4` of `lerobot-eval`, `<scenario>_trial<k>_<outcome>.mp4`
    of `roborecover eval`, `<scenario>/replay.rrd` of `dataset inspect`, and `<scenario>.mp4` or `.rrd`.

    Args:
        folder: where they are, at any depth.
        ids: scenarios to look for.
        start: of the trials. Of others than recovery points `roborecover eval` alone says the start, in the
            name: `<scenario>_<start>_trial<k>_<outcome>.mp4`.

    Returns:
        Files by scenario id.

    Raises:
        RowsError: the folder does not exist.
    """
    if not folder.is_dir():
        raise RowsError(f"no folder of videos at {folder}")
    named: dict[str, list[tuple[int, Path]]] = {}
    grouped: list[tuple[str, Path]] = []
    for path in sorted(p for p in folder.rglob("*") if p.suffix in (".mp4", ".rrd")):
        if path.name in _OF_A_FOLDER:
            grouped.append((path.parent.name, path))
            continue
        match = _TRIAL.fullmatch(path.stem)
        name, trial = (match["id"], int(match["trial"])) if match else (path.stem, 0)
        named.setdefault(name, []).append((trial, path))
    found = {}
    for scenario_id in ids:
        if start is not Start.RECOVERY:
            mine = sorted(named.get(f"{scenario_id}_{start.value}", ()))
        else:
            mine = [(0, p) for name, p in grouped if name == scenario_id or name.endswith(f"_{scenario_id}")]
            mine += sorted(named.get(scenario_id, ()))
        if mine:
            found[scenario_id] = mine
    return found


def find_clips(
    folders: Sequence[tuple[str, Path]],
    ids: Sequence[str],
    limit_bytes: int,
    starts: Mapping[str, Start] | None = None,
) -> tuple[dict[str, list[TrialVideo]], list[str]]:
    """Videos to put into a page.

    Args:
        folders: title of the arm and where its videos are, at any depth.
        ids: scenarios to look for.
        limit_bytes: total size to take in; the rest is left out, and said.
        starts: of the arms' trials, by title; by default recovery points.

    Returns:
        Clips by scenario id, and remarks.

    Raises:
        RowsError: a folder does not exist.
    """
    clips: dict[str, list[TrialVideo]] = {}
    used = skipped = 0
    for name, folder in folders:
        found = find_media(folder, ids, (starts or {}).get(name, Start.RECOVERY))
        every = [(i, trial, path) for i, media in found.items() for trial, path in media[:TRIALS_SHOWN]]
        for scenario_id, trial, path in every:
            size = path.stat().st_size
            if path.suffix != ".mp4" or used + size > limit_bytes:
                skipped += 1
                continue
            used += size
            data = base64.b64encode(path.read_bytes()).decode()
            clips.setdefault(scenario_id, []).append(TrialVideo(name, f"data:video/mp4;base64,{data}", trial))
    if skipped:
        limit = f"all together exceed {limit_bytes // 2**20} MiB"
        return clips, [f"{skipped} video(s) are left out: {limit}, or are no .mp4"]
    return clips, []
