"""Rebuilds a dataset's own metadata after LeRobot's tools (merge, delete, split, edit) have worked on it.

Those tools keep data columns but not `meta/roborecover/`. Each episode still names its row and holds its
exact actions, by which it is found again in the datasets that it came from. Rows are then numbered anew, in
the data as well, because a merge brings equal numbers together.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lerobot_roborecover.datasets.episodes import SCENARIO_INDEX
from lerobot_roborecover.datasets.files import FolderUpdate, update_folder
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import LastFrames
from lerobot_roborecover.datasets.load import load_scenarios
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.datasets.trajectories import (
    TRAJECTORIES_FILE,
    ScenarioLink,
    TrajectoryRow,
    TrajectorySet,
    actions_sha256,
    read_exact,
    read_trajectories,
)
from lerobot_roborecover.datasets.trajectory_write import write_metadata
from lerobot_roborecover.datasets.video_frames import check_frames
from lerobot_roborecover.datasets.write import replace_scenarios
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.text import pluralize


@dataclass(frozen=True)
class Repaired:
    """What was done, in words for people."""

    lines: tuple[str, ...]
    changed: bool
    ids: tuple[str, ...] = ()
    """Ids of the scenarios, by episode; empty for trajectories."""


def repair(
    root: str | os.PathLike[str],
    sources: Sequence[str],
    *,
    dry_run: bool = False,
    update: FolderUpdate | None = None,
) -> Repaired:
    """Rebuilds the scenarios or trajectories of a dataset from its episodes and the datasets they came from.

    What was known of candidates, decided and voted, `build.repair.repair_dataset` brings back on top.

    Args:
        root: the dataset that a tool has made.
        sources: the datasets it was made from: folders, or for scenarios also Hub ids.
        dry_run: find out and check, and change nothing.
        update: of `root`, that takes the changes; None makes one of its own.

    Raises:
        ScenarioError: an episode is in none of the sources, or was changed itself; nothing is changed then.
    """
    root = Path(root)
    if update is None and not dry_run:
        with update_folder(root) as update:
            done = repair(root, sources, update=update)
        if (root / FOLDER / TRAJECTORIES_FILE).is_file():
            read_trajectories(root)
        return done
    episodes = read_edited(root, sources)
    kinds = {(Path(s) / FOLDER / TRAJECTORIES_FILE).is_file() for s in sources}
    if len(kinds) > 1:
        raise ScenarioError(
            "some sources are scenario datasets and some trajectory datasets; repair needs one kind"
        )
    if kinds.pop():
        return _repair_trajectories(
            episodes, [read_trajectories(s, videos=False) for s in sources], None if dry_run else update
        )
    return _repair_scenarios(episodes, sources, None if dry_run else update)


def read_edited(root: Path, sources: Sequence[str]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The episodes of a dataset that is to be repaired: exact actions and scenario rows of each.

    Raises:
        ScenarioError: there are none, their videos have other numbers of frames, or no source is named.
    """
    if not (root / "data").is_dir():
        raise ScenarioError(f"{root} has no data/: it holds no episodes, and nothing to repair from")
    if not sources:
        raise ScenarioError("name the datasets that this one was made from: --from SOURCE ...")
    episodes = read_exact(root)
    if not episodes:
        raise ScenarioError(f"{root} has no episodes")
    check_frames(root, [len(actions) for actions, _ in episodes], thorough=True)
    return episodes


def _repair_scenarios(
    episodes: Sequence[tuple[np.ndarray, np.ndarray]], sources: Sequence[str], update: FolderUpdate | None
) -> Repaired:
    sets = [load_scenarios(source) for source in sources]
    by_prefix: dict[str, list[tuple[int, Scenario]]] = {}
    for found in sets:
        for row, scenario in enumerate(found):
            by_prefix.setdefault(actions_sha256(scenario.prefix), []).append((row, scenario))
    chosen = []
    for number, (actions, index) in enumerate(episodes):
        said = _one(number, index)
        matches = by_prefix.get(actions_sha256(actions), [])
        unique = {s.id: s for row, s in matches if row == said} or {s.id: s for _, s in matches}
        chosen.append(_only(number, unique, len(actions)))
    names = [s.id for s in chosen]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ScenarioError(
            f"scenario {twice[0]!r} has {names.count(twice[0])} episodes; a scenario dataset has one of each."
            " Delete the others with LeRobot's delete_episodes"
        )
    manifests = [found.manifest for found in sets]
    total = sum(len(found) for found in sets)
    lines = [
        f"{pluralize(len(episodes), 'episode')} found again in {pluralize(len(sets), 'source')} by "
        "their exact actions",
        f"scenarios.parquet: {len(chosen)} of {pluralize(total, 'scenario')}, in the order of the episodes",
    ]
    if update is None:
        return Repaired((*lines, "dry run: nothing was changed"), False, tuple(names))
    moved = _renumber(update, list(range(len(chosen))))
    licenses = {m.get("license") for m in manifests}
    replace_scenarios(
        update,
        chosen,
        description=" ".join(dict.fromkeys(m.get("description", "") for m in manifests)).strip(),
        license=licenses.pop() if len(licenses) == 1 else None,
        frames=_last_frames(sources, chosen),
    )
    return Repaired((*lines, f"{SCENARIO_INDEX}: {pluralize(moved, 'frame')} renumbered"), True, tuple(names))


def _last_frames(sources: Sequence[str], scenarios: Sequence[Scenario]) -> Iterator[LastFrames]:
    """The last frames of scenarios, where the sources are folders that hold some."""
    stores = [FrameStore(source) for source in sources if Path(source).is_dir()]
    for scenario in scenarios:
        for store in stores:
            if scenario.id in store and store[scenario.id].sha256 == scenario.sha256():
                yield store[scenario.id]
                break


def _repair_trajectories(
    episodes: Sequence[tuple[np.ndarray, np.ndarray]],
    sets: Sequence[TrajectorySet],
    update: FolderUpdate | None,
) -> Repaired:
    kinds = {s.kind for s in sets}
    if len(kinds) > 1:
        raise ScenarioError(f"the sources are of kinds {', '.join(sorted(kinds))}; repair needs one kind")
    by_actions: dict[str, list[tuple[TrajectoryRow, ScenarioLink | None]]] = {}
    for found in sets:
        for row in found.rows:
            link = found.scenarios[row.scenario_index] if row.scenario_index >= 0 else None
            by_actions.setdefault(row.actions_sha256, []).append((row, link))
    links: dict[str, ScenarioLink] = {}
    rows: list[TrajectoryRow] = []
    for number, (actions, index) in enumerate(episodes):
        said = _one(number, index)
        matches = by_actions.get(actions_sha256(actions), [])
        matches = [m for m in matches if m[0].scenario_index == said] or matches
        unique = {repr((replace(row, scenario_index=0), link)): (row, link) for row, link in matches}
        row, link = _only(number, unique, len(actions))
        if link is not None and links.setdefault(link.id, link) != link:
            raise ScenarioError(f"two sources have different scenarios, or splits, under the id {link.id!r}")
        rows.append(replace(row, scenario_index=-1 if link is None else list(links).index(link.id)))
    lines = [
        f"{pluralize(len(episodes), 'episode')} found again in {pluralize(len(sets), 'source')} by "
        "their exact actions",
        f"{TRAJECTORIES_FILE}: {pluralize(len(rows), 'trajectory')} of {pluralize(len(links), 'scenario')}",
    ]
    if update is None:
        return Repaired((*lines, "dry run: nothing was changed"), False)
    moved = _renumber(update, [row.scenario_index for row in rows])
    manifests = [s.manifest for s in sets]
    licenses = {m.get("license") for m in manifests}
    write_metadata(
        update.folder,
        kinds.pop(),
        list(links.values()),
        rows,
        labels=_labels(update, list(links.values())),
        description=" ".join(dict.fromkeys(m.get("description", "") for m in manifests)).strip(),
        license=licenses.pop() if len(licenses) == 1 else None,
    )
    return Repaired((*lines, f"{SCENARIO_INDEX}: {pluralize(moved, 'frame')} renumbered"), True)


def _one(number: int, index: np.ndarray) -> int:
    """The one scenario row that all frames of an episode name."""
    if len(set(index.tolist())) != 1:
        raise ScenarioError(
            f"episode {number}: its frames name the scenario rows {sorted(set(index.tolist()))[:8]}; an "
            "episode belongs to one. Frames were moved between episodes: start again from the sources"
        )
    return int(index[0])


def _only[T](number: int, matches: dict[str, T], steps: int) -> T:
    if len(matches) != 1:
        raise ScenarioError(
            f"episode {number} ({steps} actions): {len(matches)} entries of the sources have these actions"
            + (
                ". Name every dataset that it came from"
                if not matches
                else f" ({', '.join(list(matches)[:4])[:200]}); not distinguishable. Remove all but one"
            )
        )
    return next(iter(matches.values()))


def _renumber(update: FolderUpdate, rows: Sequence[int]) -> int:
    """Writes each episode's new scenario row into the data; returns the number of frames that changed."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    from lerobot_roborecover.datasets.parquet_read import number_array, read_table

    changed = 0
    for path in _data_files(update):
        table = read_table(path)
        position = table.schema.get_field_index(SCENARIO_INDEX)
        field = table.schema.field(position)
        old = number_array(table[SCENARIO_INDEX]).reshape(len(table), -1)[:, 0].tolist()
        new = [rows[e] for e in number_array(table["episode_index"]).tolist()]
        if old == new:
            continue
        changed += sum(a != b for a, b in zip(old, new, strict=True))
        nested = pa.types.is_list(field.type) or pa.types.is_fixed_size_list(field.type)
        column = pa.array([[v] for v in new] if nested else new, field.type)
        target = update.folder / path.relative_to(update.root)
        target.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table.set_column(position, field, column), target, compression="snappy")
        shutil.copymode(path, target)
    return changed


def _data_files(update: FolderUpdate) -> list[Path]:
    """Returns the data files that the dataset will have, those of the update in the place of its own."""
    names = [p.relative_to(update.root).as_posix() for p in sorted((update.root / "data").rglob("*.parquet"))]
    return [update.path(name) for name in names]


def _labels(update: FolderUpdate, links: Sequence[ScenarioLink]) -> dict[tuple[str, int], int]:
    """Frames by split and label, where the data is of a monitor."""
    from lerobot_roborecover.datasets.parquet_read import column_names, read_numbers
    from lerobot_roborecover.datasets.trajectories import LABEL

    counts: dict[tuple[str, int], int] = {}
    for path in _data_files(update):
        if LABEL not in column_names(path):
            continue
        table = read_numbers(path, [LABEL, SCENARIO_INDEX])
        columns = (table[name].reshape(len(table[name]), -1)[:, 0] for name in (LABEL, SCENARIO_INDEX))
        for label, index in zip(*(column.tolist() for column in columns), strict=True):
            if index >= 0:
                key = (links[index].split, int(label))
                counts[key] = counts.get(key, 0) + 1
    return counts
