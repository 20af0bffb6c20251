"""Writes the candidates of a collection: rendered by replay in the workers, in parts, joined at the end.

A rollout is not rendered while it runs, unless its policy looks at pictures. What is kept is replayed
afterwards, which is exact, and looked at before each action; a replay that is not where the rollout was is
dropped.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover._version import __version__
from lerobot_roborecover.curation.candidates import Candidate, read_candidates
from lerobot_roborecover.curation.candidates_write import Recording, merge_candidates, write_candidates
from lerobot_roborecover.curation.collect.judge import RolloutVerdict
from lerobot_roborecover.curation.collect.record import Record, read_record, record_path
from lerobot_roborecover.curation.collect.server import RenderedRollout, VideoJob
from lerobot_roborecover.curation.funnel import Decision, record_decisions
from lerobot_roborecover.curation.video_settings import VideoSettings
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.datasets.trajectory_write import Trajectory
from lerobot_roborecover.scenario import HANDOFF_TOLERANCE_M, Rollout, ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir, atomic_write
from lerobot_roborecover.workers.dispatch import failed, map_ordered
from lerobot_roborecover.workers.slots import SlotPool

COLLECT_FILE = "collect.json"
SCHEMA_VERSION = 1


@dataclass(frozen=True)
class WriterConfig:
    """Settings for writing a collection."""

    records: Path
    """Folder of the rollouts' records."""
    parts: Path
    """Folder of the parts."""
    pool: SlotPool
    """Slots that render, with `collect_server.SERVER`."""
    slots: int
    fps: int
    versions: Mapping[str, str]
    """Versions of the simulator."""
    frames: str
    """What is rendered; names the parts, so that another size is rendered anew."""
    video: VideoSettings
    """Kept with every candidate, so that what was seen can be rendered again."""
    replay: bool = True
    """Replay rollouts whose records have these observations too: they have no pictures."""
    part_size: int = 20
    """Candidates of a part: what is lost, at most, when the writing is stopped."""
    description: str = ""
    license: str | None = None


def write_collection(
    out: Path,
    kept: Sequence[RolloutVerdict],
    dropped: Iterable[Decision],
    writing: WriterConfig,
    about: Mapping[str, Any],
    on_rendered: Callable[[int], None] = lambda done: None,
) -> Path:
    """Renders and writes what is kept; `out` appears as a whole, or not at all.

    Args:
        out: new or empty.
        kept: candidates, in the order of their episodes.
        dropped: decisions on all other rollouts.
        writing: how.
        about: content of `meta/roborecover/collect.json`.
        on_rendered: called with how many are written.

    Raises:
        ScenarioError: nothing could be written, or the folder is not new.
    """
    parts, lost, done = [], [], 0
    size = writing.part_size
    for first in range(0, len(kept), size):
        chunk = kept[first : first + size]
        part = writing.parts / _part_name(chunk, writing.frames)
        if not part.is_dir():
            with suppress(_NothingLeft):
                _write_part(part, chunk, writing, lambda n, done=done: on_rendered(done + n))
        there = set(read_candidates(part).by_id) if part.is_dir() else set()
        notes = _read_lost(part)
        lost += [
            Decision(
                v.planned.id, "collect", "dropped", *notes.get(v.planned.id, ("not rendered", "")), "replay"
            )
            for v in chunk
            if v.planned.id not in there
        ]
        parts += [part] if there else []
        done += len(chunk)
        on_rendered(done)
    if not parts:
        raise ScenarioError(
            f"none of the {len(kept)} candidates could be rendered, so {out} is not written. The first: "
            f"{lost[0].reason}: {lost[0].detail}"
        )
    with atomic_dir(out) as whole:
        merge_candidates(whole, parts)
        record_decisions(whole, [*dropped, *lost])
        document = {"schema_version": SCHEMA_VERSION, "written_by": {"lerobot_env_roborecover": __version__}}
        text = json.dumps({**document, **about}, indent=2, allow_nan=False)
        (whole / FOLDER / COLLECT_FILE).write_text(text + "\n", encoding="utf-8")
    return out


def read_about(out: Path) -> dict[str, Any] | None:
    """Reads `collect.json` of a finished collection; None where there is none.

    Raises:
        ScenarioError: it cannot be read.
    """
    path = out / FOLDER / COLLECT_FILE
    try:
        found = json.loads(path.read_bytes())
        if not isinstance(found, dict) or found.get("schema_version") != SCHEMA_VERSION:
            raise ValueError("of another version")
        return found
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as err:
        raise ScenarioError(f"{path} cannot be read ({err!s:.200}). Give another --out") from None


class _NothingLeft(Exception):
    """No rollout of a part could be rendered."""


def _write_part(
    part: Path, chunk: Sequence[RolloutVerdict], writing: WriterConfig, on_rendered: Callable[[int], None]
) -> None:
    lost: dict[str, tuple[str, str]] = {}
    renderings = _rendered(chunk, writing, lost)
    first = next(renderings, None)
    _write_lost(part, lost)
    if first is None:
        raise _NothingLeft

    def draw() -> Iterator[Recording]:
        count = 0
        recording: Recording | None = first
        while recording is not None:
            yield recording
            count += 1
            on_rendered(count + len(lost))
            recording = next(renderings, None)
            _write_lost(part, lost)

    write_candidates(
        part,
        draw(),
        fps=writing.fps,
        versions=writing.versions,
        description=writing.description,
        license=writing.license,
    )


def _rendered(
    chunk: Sequence[RolloutVerdict], writing: WriterConfig, lost: dict[str, tuple[str, str]]
) -> Iterator[Recording]:
    """Recordings of a part, as they are rendered; notes those that are lost, and why."""

    records = {v.planned.id: read_record(record_path(writing.records, v.planned.id)) for v in chunk}

    def seen(v: RolloutVerdict) -> RenderedRollout | None:
        record = records[v.planned.id]
        if writing.replay or record.observations is None or record.observe_every != writing.video.every:
            return None
        return RenderedRollout(record.observations, 0.0)

    def job(v: RolloutVerdict) -> VideoJob:
        record = records[v.planned.id]
        poses = record.steps.bodies

        return VideoJob(
            Rollout(v.planned.task, record.reset, record.actions),
            tuple(poses),
            np.stack(list(poses.values())),
            writing.video.every,
        )

    unseen = [v for v in chunk if seen(v) is None]
    workers = writing.pool.worker_slots(min(writing.slots, len(unseen))) if unseen else []
    replayed = map_ordered(workers, "render", unseen, job) if unseen else iter(())
    for v in chunk:
        rendered = seen(v) or next(replayed)
        if failed(rendered):
            lost[v.planned.id] = "could not be replayed", failed(rendered)[:500]
            continue
        assert isinstance(rendered, RenderedRollout)
        if rendered.error_m > HANDOFF_TOLERANCE_M:
            lost[v.planned.id] = (
                "its replay is another rollout",
                f"up to {1e3 * rendered.error_m:.2f} mm apart (limit {1e3 * HANDOFF_TOLERANCE_M:g} mm)",
            )
            continue
        yield _recording(v, records[v.planned.id], rendered, writing.video)
    assert next(replayed, None) is None


def _recording(
    v: RolloutVerdict, record: Record, rendered: RenderedRollout, video: VideoSettings
) -> Recording:
    from lerobot_roborecover.datasets.episodes import to_frame

    planned = v.planned
    return Recording(
        Candidate(planned.id, planned.source),
        Trajectory(
            task=planned.task,
            driver=planned.driver,
            actions=record.actions,
            frames=(to_frame(planned.platform, o) for o in rendered.observations),
            success=False,
            reset=record.reset,
            provenance={"collect": {**(v.notes or {}), "film": video.note()}},
        ),
        record.steps,
        *((v.exclusion.reason, v.exclusion.detail, f"rule {v.exclusion.rule}") if v.exclusion else ()),
    )


def _part_name(chunk: Sequence[RolloutVerdict], frames: str) -> str:
    """By what is in it, so that a part of other candidates, notes or pictures is another part."""
    text = [frames, [[v.planned.id, v.notes, v.exclusion and vars(v.exclusion)] for v in chunk]]
    return hashlib.sha256(json.dumps(text, sort_keys=True).encode()).hexdigest()[:20]


def _lost_path(part: Path) -> Path:
    return part.with_name(f"{part.name}.lost.json")


def _write_lost(part: Path, lost: Mapping[str, tuple[str, str]]) -> None:
    atomic_write(_lost_path(part), json.dumps(lost))


def _read_lost(part: Path) -> dict[str, tuple[str, str]]:
    try:
        return {k: (str(a), str(b)) for k, (a, b) in json.loads(_lost_path(part).read_text()).items()}
    except (OSError, ValueError, AttributeError):
        return {}
