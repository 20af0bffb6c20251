"""Pulls a whole dataset from the Hub into a folder: all of it, checked, or nothing.

Downloads go to the Hub cache, where a stopped one goes on; the folder appears only when every file is there
and is what it should be.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from huggingface_hub import HfApi, snapshot_download
from huggingface_hub.hf_api import RepoFile

from lerobot_roborecover.datasets.certificate import CERTIFICATE_FILE
from lerobot_roborecover.datasets.contents import MAX_FILE_BYTES, check_file, check_names
from lerobot_roborecover.datasets.retries import retry
from lerobot_roborecover.datasets.schema import (
    FOLDER,
    MANIFEST_FILE,
    MAX_MANIFEST_BYTES,
    MAX_PARQUET_BYTES,
    SCENARIOS_FILE,
)
from lerobot_roborecover.datasets.trajectories import TRAJECTORIES_FILE, read_trajectories
from lerobot_roborecover.datasets.video_frames import check_frames
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir, check_new

_EVALUATION = (f"{FOLDER}/{MANIFEST_FILE}", f"{FOLDER}/{SCENARIOS_FILE}")
_LIMITS = {_EVALUATION[0]: MAX_MANIFEST_BYTES, _EVALUATION[1]: MAX_PARQUET_BYTES}


@dataclass(frozen=True)
class Pulled:
    root: Path
    commit: str
    """The revision to pin."""
    files: int
    bytes: int


def pull_dataset(
    repo_id: str, out: str | os.PathLike[str], *, revision: str | None = None, evaluation_only: bool = False
) -> Pulled:
    """Downloads a dataset of this package into a new folder.

    Args:
        repo_id: "org/name".
        out: the folder; must not exist, or be empty.
        revision: tag, branch or commit; by default the default branch.
        evaluation_only: `meta/roborecover/` alone, without episodes and card.

    Raises:
        ScenarioError: it cannot be reached, holds a file that does not belong there, is not valid, or the
            folder is not empty.
    """
    out = Path(out)
    check_new(out)
    where = f"Hub dataset {repo_id}" + (f" at revision {revision!r}" if revision else "")
    api = HfApi()
    info = retry(lambda: api.dataset_info(repo_id, revision=revision), where)
    commit = str(info.sha)
    entries = retry(
        lambda: [
            e
            for e in api.list_repo_tree(repo_id, recursive=True, revision=commit, repo_type="dataset")
            if isinstance(e, RepoFile)
        ],
        f"{where}: listing its files",
    )
    entries = _wanted(where, entries, evaluation_only)
    size = sum(e.size for e in entries)
    out.parent.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(out.parent).free
    if size > free:
        raise ScenarioError(f"{where} has {size / 1e9:.1f} GB; {out.parent} has {free / 1e9:.1f} GB free")
    snapshot = retry(
        lambda: snapshot_download(
            repo_id, repo_type="dataset", revision=commit, allow_patterns=[e.path for e in entries]
        ),
        f"{where}: downloading",
    )
    try:
        with atomic_dir(out) as folder:
            for entry in entries:
                target = folder / entry.path
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(Path(snapshot) / entry.path, target)
                if target.stat().st_size != entry.size:
                    raise ScenarioError(
                        f"{where}: {entry.path} has {target.stat().st_size} bytes, the Hub says "
                        f"{entry.size}. Delete it from the Hub cache and pull again"
                    )
                check_file(folder, entry.path)
            validate(folder)
    except FileNotFoundError as err:
        raise ScenarioError(f"{where}: {err.filename} did not arrive; pull again") from None
    return Pulled(out, commit, len(entries), size)


def validate(root: Path, *, thorough: bool = False) -> None:
    """Reads what a dataset says of itself, and counts its videos' frames.

    Args:
        root: the dataset's folder.
        thorough: look at the time of every video frame.

    Raises:
        ScenarioError: it is no valid dataset of this package.
    """
    from lerobot_roborecover.datasets.frame_files import FrameStore
    from lerobot_roborecover.datasets.read import read_scenarios

    if (root / FOLDER / TRAJECTORIES_FILE).is_file():
        steps = [row.steps for row in read_trajectories(root).rows]
    else:
        steps = [len(s.prefix) for s in read_scenarios(root)]
        FrameStore(root)
    check_frames(root, steps, thorough=thorough)


def _wanted(where: str, entries: Sequence[RepoFile], evaluation_only: bool) -> list[RepoFile]:
    """The files to download; refuses what no dataset of this package holds, before any of it is fetched."""
    by_path = {e.path: e for e in entries}
    missing = [path for path in _EVALUATION if path not in by_path]
    if missing and (evaluation_only or f"{FOLDER}/{TRAJECTORIES_FILE}" not in by_path):
        raise ScenarioError(f"{where} holds no {missing[0]}: it is not a scenario dataset. Check the id")
    wanted = list(entries)
    if evaluation_only:
        wanted = [by_path[p] for p in (*_EVALUATION, f"{FOLDER}/{CERTIFICATE_FILE}") if p in by_path]
    check_names(where, (e.path for e in wanted))
    for entry in wanted:
        limit = _LIMITS.get(entry.path, MAX_FILE_BYTES)
        if entry.size > limit:
            raise ScenarioError(f"{where}: {entry.path} has {entry.size} bytes; the limit is {limit}")
    return wanted
