"""Candidate datasets through LeRobot's own writer: whole or not at all, joined, and read back exactly."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.curation.annotation.frames import Videos
from lerobot_roborecover.curation.annotation.votes import Vote, VoteJournal, read_votes
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.candidates_write import Recording, merge_candidates, write_candidates
from lerobot_roborecover.curation.collect.collection import Collected, describe
from lerobot_roborecover.curation.funnel import (
    Decision,
    attrition_table,
    count_stages,
    read_decisions,
    record_decisions,
)
from lerobot_roborecover.curation.resolution import queued
from lerobot_roborecover.datasets.contents import list_files
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.datasets.trajectory_write import Trajectory
from lerobot_roborecover.scenario import Reset, ScenarioError
from tests.support.candidate_files import (
    CAMERAS,
    FPS,
    candidate,
    fake_task,
    number_of,
    numbered_frame,
    rollout,
)

pytestmark = pytest.mark.lerobot
STEPS = 12


def recording(index: int, **changes) -> Recording:
    """A rollout whose frames show their number and, as the clip, the candidate's."""
    actions, steps = rollout(index % 6, STEPS)
    frames = [{key: numbered_frame(t, index, c) for c, key in enumerate(CAMERAS)} for t in range(STEPS)]
    made = Trajectory(
        fake_task(index), "noise", actions, frames, False, reset=Reset(seed=index % 6, settle_steps=2)
    )
    return replace(Recording(candidate(index), made, steps), **changes)


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """Two datasets of two candidates, one of which a rule excludes."""
    base = tmp_path_factory.mktemp("parts")
    first = [
        recording(0),
        recording(1, exclusion="stuck", exclusion_detail="joint 3 at 2.97 rad", excluded_by="rule"),
    ]
    # Suggestions lie beyond these short rollouts.
    for i, recordings in enumerate((first, [recording(2), recording(3)])):
        short = [replace(r, candidate=replace(r.candidate, suggestions=())) for r in recordings]
        write_candidates(base / f"part-{i}", short, fps=FPS, versions={"fake": "1"}, license="mit")
    return base


def test_parts_become_one_and_say_what_they_said(parts, tmp_path):
    root = merge_candidates(tmp_path / "all", [parts / "part-0", parts / "part-1"])
    found, videos = read_candidates(root), Videos(root)
    assert [c.id for c in found.candidates] == [f"ep-000{i}" for i in range(4)]
    assert found.trajectories.manifest["license"] == "mit"
    assert videos.fps == FPS
    for i in range(4):
        actions, steps = rollout(i, STEPS)
        assert found.actions(i).tobytes() == actions.tobytes()
        assert found.steps(i).bodies["puck"].tobytes() == steps.bodies["puck"].tobytes()
        assert found.row(i).reset_record() == Reset(seed=i, settle_steps=2)
        for camera in CAMERAS:
            shown = videos.decode(camera, i, 0, STEPS)
            assert [number_of(f) for f in shown] == [(t, i) for t in range(STEPS)]
            assert [number_of(f) for f in videos.decode(camera, i, 7, 3)] == [(t, i) for t in (7, 8, 9)]
    # Nothing in it that could not be published, and nothing left beside it.
    assert "meta/roborecover/steps.parquet" in list_files(root)
    assert [p.name for p in tmp_path.iterdir()] == ["all"]
    assert attrition_table(count_stages(read_decisions(root))).splitlines()[1:] == [
        "collect        4     3          0        1",
        "                                         1  stuck",
    ]
    told = describe(Collected(root, tuple(count_stages(read_decisions(root))), len(found)))
    assert f"3 candidates in {root}; 1 beside them that a rule leaves out" in told
    # An exclusion is a decision like another: a person may take it back, and both stay on record.
    assert queued(found) == {"ep-0000", "ep-0002", "ep-0003"}
    assert record_decisions(root, [Decision("ep-0001", "collect", "kept", by="ann")]) == 1
    assert record_decisions(root, [Decision("ep-0001", "collect", "kept", by="ann")]) == 0
    assert queued(found) == {f"ep-000{i}" for i in range(4)}
    assert [d.verdict for d in read_decisions(root) if d.candidate == "ep-0001"] == ["dropped", "kept"]


def test_joined_datasets_bring_their_votes_and_pictures(parts, tmp_path):
    sources = [shutil.copytree(parts / name, tmp_path / name) for name in ("part-0", "part-1")]
    marked = Vote("", "", "recovery", 7, "Move", "Wrong Pose")
    for number, root in enumerate(sources):
        book = VoteJournal(root / FOLDER / "votes", "ann", 1)
        book.add(replace(marked, uid=f"vote-{number}-of-ann", candidate=f"ep-000{2 * number}"))
        book.close()
    (sources[1] / FOLDER / "examples").mkdir()
    (sources[1] / FOLDER / "examples" / "move.png").write_bytes(b"png")
    whole = merge_candidates(tmp_path / "all", sources)
    (records,) = read_votes(whole / FOLDER / "votes").values()
    assert [(r["uid"], r["candidate"]) for r in records] == [
        ("vote-0-of-ann", "ep-0000"),
        ("vote-1-of-ann", "ep-0002"),
    ]
    assert (whole / FOLDER / "examples" / "move.png").read_bytes() == b"png"


def test_what_does_not_fit_leaves_nothing_behind(parts, tmp_path):
    good = replace(recording(0), candidate=replace(candidate(0), suggestions=()))
    short = replace(good.steps, solved=good.steps.solved[:-1])
    no_eef = replace(good.steps, bodies={"puck": good.steps.bodies["puck"]})
    cut = replace(good.steps, bodies={"eef": np.zeros((STEPS, 7))})
    for recordings, said in (
        ([good, good], "ids are unique"),
        ([recording(0)], "suggests step 17; its frames are 0 to 11"),
        ([replace(good, steps=short)], "12 actions have 13 and 12"),
        ([replace(good, steps=no_eef)], "with an end effector"),
        ([replace(good, steps=cut)], r"must be \(13, 7\) each"),
        ([replace(good, trajectory=replace(good.trajectory, not_replayable="lost"))], "cannot be replayed"),
        ([], "no trajectories"),
    ):
        with pytest.raises(ScenarioError, match=said):
            write_candidates(tmp_path / "set", recordings, fps=FPS, versions={"fake": "1"})
        assert list(tmp_path.iterdir()) == []
    with pytest.raises(ScenarioError, match="ids are unique"):
        merge_candidates(tmp_path / "set", [parts / "part-0", parts / "part-0"])
    assert list(tmp_path.iterdir()) == []
