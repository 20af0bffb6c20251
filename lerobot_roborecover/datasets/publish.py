"""Publishes a dataset folder on the Hub: one commit, a version tag that stays, and LeRobot's format tag.

In this order, so that a stop at any point leaves what was published before untouched, and a rerun goes on:

1. everything is checked here, and the card is made;
2. large files are uploaded; the Hub keeps those that arrived, so that a rerun sends only the rest;
3. one commit makes all of it visible at once, on top of the commit that was compared with;
4. the tags are set.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi
from huggingface_hub.errors import RepositoryNotFoundError
from huggingface_hub.hf_api import RepoFile

from lerobot_roborecover.datasets.benchmark import EVAL_FILE, VIEWER_FOLDER
from lerobot_roborecover.datasets.card import MARK, CardFiles, make_card
from lerobot_roborecover.datasets.contents import check_file, list_files
from lerobot_roborecover.datasets.licenses import license_argument
from lerobot_roborecover.datasets.pull import validate
from lerobot_roborecover.datasets.retries import ATTEMPTS, HubUnreachable, retry
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.options import internal, option
from lerobot_roborecover.utils.text import pluralize

LEROBOT_TAG = "v3.0"
"""LeRobot loads a dataset at the tag of its own format version."""
TAG_PREFIX = "roborecover-"
"""Our versions do not begin with `v`: LeRobot would take them for versions of its format."""
_VERSION = re.compile(r"[0-9]+\.[0-9]+(\.[0-9]+)?")
_FILES_PER_UPLOAD = 20


@dataclass(frozen=True)
class PublishConfig:
    """What to publish, where, and as what."""

    repo_id: str = option(metavar="ORG/NAME")
    """Where on the Hub."""
    license: str | None = option(None, parse=license_argument)
    """Licence by the Hub's identifier, e.g. cc-by-4.0; by default the one in the dataset's manifest."""
    version: str = "1.0.0"
    """Version of the dataset; tag roborecover-VERSION."""
    private: bool = False
    """Make a new repository private.

    An existing one keeps its visibility.
    """
    force: bool = False
    """Move the tag of a version that is published already."""
    title: str = ""
    """Title of the card (default: the repository's name)."""
    pictures: bool = True
    """No grid of recovery frames in the card.

    There is one where the dataset holds frames.
    """
    frames: Mapping[str, np.ndarray] | None = internal(None)
    """(H, W, 3) uint8 by scenario id: rendered pictures for the grid instead."""
    called: str = internal("")
    """What the plan calls the dataset; its folder by default."""


@dataclass(frozen=True)
class PublishPlan:
    """What publishing would do."""

    config: PublishConfig
    root: Path
    card: CardFiles
    exists: bool
    """Whether the repository is there already."""
    head: str | None
    """Its commit that the plan was made against."""
    add: tuple[str, ...]
    """Paths that are new or differ."""
    delete: tuple[str, ...]
    """Paths that are no longer part of the dataset."""
    same: int
    """Number of files that are there already."""
    bytes: int
    """Size of `add`."""
    tags: Mapping[str, bool]
    """Tags to set, and whether that moves one."""
    unreachable: str = ""
    """Why the Hub was not compared with; such a plan can be shown, not carried out."""

    def lines(self) -> list[str]:
        seen = "private" if self.config.private else "public"
        where = "an existing repository" if self.exists else f"a new {seen} repository"
        tags = ", ".join(f"{t} (moved)" if moved else t for t, moved in self.tags.items())
        if self.unreachable:
            return [
                f"dataset   {self.config.called or self.root}",
                f"to        {self.config.repo_id}; if it does not exist, {where} is made",
                f"unknown   what is there already: {self.unreachable}",
                f"upload    at most {pluralize(len(self.add), 'file')}, {self.bytes / 1e6:.1f} MB",
                *(f"  + {name}" for name in self.add),
                "delete    files that are there and not in the dataset",
                f"tags      {tags}; refused where the version is published already and differs",
                f"licence   {self.card.license}",
            ]
        return [
            f"dataset   {self.config.called or self.root}",
            f"to        {self.config.repo_id}, {where}" + (f" at {self.head}" if self.head else ""),
            f"upload    {pluralize(len(self.add), 'file')}, {self.bytes / 1e6:.1f} MB; "
            f"{self.same} are there already",
            *(f"  + {name}" for name in self.add),
            f"delete    {pluralize(len(self.delete), 'file')}",
            *(f"  - {name}" for name in self.delete),
            f"tags      {tags}",
            f"licence   {self.card.license}",
        ]


@dataclass(frozen=True)
class Published:
    commit: str
    tags: tuple[str, ...]
    url: str


def plan_publish(
    root: str | os.PathLike[str], config: PublishConfig, *, to_show: bool = False
) -> PublishPlan:
    """Checks a dataset and finds out what publishing it would change; changes nothing.

    Args:
        root: the dataset's folder.
        config: what to publish, where, and as what.
        to_show: make a plan without comparing where the Hub does not answer.

    Raises:
        ScenarioError: the dataset is not valid, there is no licence, or the version is published already.
    """
    root = Path(root)
    check_version(config.version)
    names = list_files(root)
    for name in names:
        check_file(root, name)
    card = make_card(
        root,
        config.repo_id,
        license=config.license,
        version=config.version,
        tag=TAG_PREFIX + config.version,
        title=config.title,
        pictures=config.pictures,
        frames=config.frames,
    )
    validate(root, thorough=True)
    # The viewer's tables are made anew: one of a split that is gone does not stay.
    own = {name: root / name for name in names if not name.startswith(f"{VIEWER_FOLDER}/")}
    local: dict[str, Path | bytes] = {**own}
    local |= {name: data for name, data in card.files.items() if name not in own or _replaceable(own[name])}
    api, where = HfApi(), f"Hub dataset {config.repo_id}"
    refs, head, remote, unreachable = None, None, {}, ""
    attempts = 1 if to_show else ATTEMPTS
    try:
        missing = (RepositoryNotFoundError,)
        refs = retry(lambda: _refs(api, config.repo_id), f"{where}: looking it up", missing, attempts)
        main = refs["branches"].get("main")
        if main:
            head = main
            remote = retry(
                lambda: _remote_files(api, config.repo_id, main), f"{where}: listing", attempts=attempts
            )
    except RepositoryNotFoundError:
        pass
    except HubUnreachable as err:
        if not to_show:
            raise
        refs, head, unreachable = None, None, str(err)
    digests = {name: _digests(source) for name, source in local.items()}
    add = tuple(n for n in sorted(local) if remote.get(n) not in digests[n][:2])
    delete = tuple(sorted(set(remote) - set(local) - {".gitattributes"}))
    tags = {TAG_PREFIX + config.version: False}
    if "meta/info.json" in local:
        tags[LEROBOT_TAG] = False
    for tag in tags:
        if refs and tag in refs["tags"]:
            moves = bool(add or delete) or refs["tags"][tag] != head
            tags[tag] = moves
            if tag != LEROBOT_TAG and moves and not config.force:
                raise ScenarioError(
                    f"{where}: version {config.version} is published already (tag {tag}, commit "
                    f"{refs['tags'][tag]}) and differs from this dataset. Give a new --version, or --force "
                    "to move the tag: results that cite it would then be of another dataset"
                )
    return PublishPlan(
        config,
        root,
        card,
        refs is not None,
        head,
        add,
        delete,
        len(local) - len(add),
        sum(digests[n][2] for n in add),
        tags,
        unreachable,
    )


def check_version(version: str) -> None:
    """Checks how a version is written.

    Raises:
        ScenarioError: it is not like 1.0 or 1.0.0.
    """
    if not _VERSION.fullmatch(version):
        raise ScenarioError(f"version {version!r:.40} is not like 1.0 or 1.0.0")


def publish(plan: PublishPlan, progress: Callable[[int, int], None] = lambda done, total: None) -> Published:
    """Carries a plan out.

    Args:
        plan: of `plan_publish`.
        progress: called with the numbers of files uploaded and in all.

    Raises:
        ScenarioError: the Hub refuses, or does not answer; run it again to go on.
    """
    if plan.unreachable:
        raise ScenarioError(plan.unreachable)
    api, config = HfApi(), plan.config
    where = f"Hub dataset {config.repo_id}"
    retry(
        lambda: api.create_repo(config.repo_id, repo_type="dataset", private=config.private, exist_ok=True),
        f"{where}: creating it",
    )
    commit = plan.head
    if commit is None or plan.add or plan.delete:
        adds = [CommitOperationAdd(name, _source(plan, name)) for name in plan.add]
        for begin in range(0, len(adds), _FILES_PER_UPLOAD):
            part = adds[begin : begin + _FILES_PER_UPLOAD]
            # Files that a failed attempt has sent are marked as uploaded, so that another one goes on.
            retry(
                lambda part=part: api.preupload_lfs_files(
                    config.repo_id, part, repo_type="dataset", free_memory=False
                ),
                f"{where}: uploading",
            )
            progress(begin + len(part), len(adds))
        operations = [*adds, *(CommitOperationDelete(name) for name in plan.delete)]
        commit = retry(
            lambda: (
                api.create_commit(
                    config.repo_id,
                    operations,
                    commit_message=f"RoboRecover {config.version}",
                    repo_type="dataset",
                    parent_commit=plan.head,
                ).oid
            ),
            f"{where}: committing",
        )
    for tag in plan.tags:
        retry(lambda tag=tag: _set_tag(api, config.repo_id, tag, commit), f"{where}: setting tag {tag}")
    return Published(commit, tuple(plan.tags), f"{api.endpoint}/datasets/{config.repo_id}")


def _set_tag(api: HfApi, repo_id: str, tag: str, commit: str) -> None:
    tags = {t.name: t.target_commit for t in api.list_repo_refs(repo_id, repo_type="dataset").tags}
    if tags.get(tag) == commit:
        return
    if tag in tags:
        api.delete_tag(repo_id, tag=tag, repo_type="dataset")
    api.create_tag(repo_id, tag=tag, revision=commit, repo_type="dataset")


def _refs(api: HfApi, repo_id: str) -> dict[str, dict[str, str]]:
    refs = api.list_repo_refs(repo_id, repo_type="dataset")
    return {
        "branches": {b.name: b.target_commit for b in refs.branches},
        "tags": {t.name: t.target_commit for t in refs.tags},
    }


def _remote_files(api: HfApi, repo_id: str, commit: str) -> dict[str, str]:
    """Hash of each file of a commit: SHA-256 for large files, git's for the others."""
    entries = api.list_repo_tree(repo_id, recursive=True, revision=commit, repo_type="dataset")
    return {e.path: e.lfs.sha256 if e.lfs else e.blob_id for e in entries if isinstance(e, RepoFile)}


def _digests(source: Path | bytes) -> tuple[str, str, int]:
    """SHA-256, git blob hash and size of a file."""
    size = len(source) if isinstance(source, bytes) else source.stat().st_size
    sha256, blob = hashlib.sha256(), hashlib.sha1(b"blob %d\0" % size)
    if isinstance(source, bytes):
        sha256.update(source)
        blob.update(source)
    else:
        with open(source, "rb") as file:
            while chunk := file.read(2**20):
                sha256.update(chunk)
                blob.update(chunk)
    return sha256.hexdigest(), blob.hexdigest(), size


def _source(plan: PublishPlan, name: str) -> bytes | str:
    path = plan.root / name
    if name in plan.card.files and (not path.exists() or _replaceable(path)):
        return plan.card.files[name]
    return str(path)


def _replaceable(path: Path) -> bool:
    """Whether a file of the dataset was made here, and is not its owner's own."""
    if path.name not in ("README.md", EVAL_FILE):
        return True
    return MARK in path.read_text(encoding="utf-8", errors="replace")
