"""An edited candidate dataset, and that repair brings candidates, steps, decisions and votes along."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.annotation.votes import SCHEMA_VERSION as VOTES_SCHEMA
from lerobot_roborecover.curation.annotation.votes import Vote, VoteJournal, ballot, read_votes
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.funnel import Decision, count_stages, read_decisions, record_decisions
from lerobot_roborecover.curation.repair import repair_dataset
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.journal import Journal
from tests.support.candidate_files import candidate_dataset
from tests.support.release_files import files_of

STEPS = 20


def vote(name: str, candidate: int, step: int) -> dict:
    made = Vote(
        f"{name}-{candidate}-{step}", f"ep-{candidate:04d}", "recovery", step, "Move", "Wrong Pose",
        annotator=name, at="2026-01-02T03:04:05+00:00",
    )  # fmt: skip
    return {"kind": "vote", **asdict(made)}


def cast(root: Path, name: str, *records: dict) -> None:
    with Journal(root / FOLDER / "votes" / f"{name}.jsonl", VOTES_SCHEMA) as journal:
        journal.append(*records)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Five candidates with decisions of two stages, and votes of two people."""
    root = candidate_dataset(tmp_path_factory.mktemp("sets") / "source", 5, steps=45, dropped=(1,))
    record_decisions(
        root,
        [
            Decision("ep-0002", "annotate", "kept"),
            Decision("ep-0003", "annotate", "dropped", "no consensus"),
            Decision("never-rendered", "collect", "dropped", "solved"),
        ],
    )
    cast(root, "ann", vote("ann", 2, 11), vote("ann", 3, 12), vote("ann", 2, 13))
    cast(root, "bob", {"kind": "reveal", "candidate": "ep-0003", "round": 1}, vote("bob", 1, 5))
    (root / FOLDER / "examples").mkdir()
    (root / FOLDER / "examples" / "move.png").write_bytes(b"png")
    return root


def edited(source: Path, root: Path, episodes: list[int]) -> Path:
    """What LeRobot's tools leave: these episodes, numbered anew, and none of our metadata."""
    for path in source.rglob("*"):
        if path.is_file() and FOLDER not in str(path):
            target = root / path.relative_to(source)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)
    for name in ("data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"):
        table = pq.read_table(root / name)
        number = np.array(table["episode_index"])
        rows = np.concatenate([np.flatnonzero(number == e) for e in episodes])
        new = pa.array([episodes.index(e) for e in number[rows]])
        table = table.take(pa.array(rows))
        pq.write_table(
            table.set_column(table.schema.get_field_index("episode_index"), "episode_index", new), root / name
        )
    return root


def test_everything_that_goes_by_candidate_is_brought_into_agreement(source, tmp_path, capsys):
    root = edited(source, tmp_path / "set", [3, 2])
    arguments = ["repair", str(root), "--from", str(source)]
    before = files_of(root)
    assert main([*arguments, "--dry-run"]) == 0
    assert files_of(root) == before
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "candidates.json and steps.parquet: 2 candidates" in said
    assert "votes: 4 records of 2 annotators" in said

    found, original = read_candidates(root), read_candidates(source)
    assert [c.id for c in found.candidates] == ["ep-0003", "ep-0002"]
    assert found.candidates == (original.candidates[3], original.candidates[2])
    assert found.versions == original.versions
    for episode, old in enumerate((3, 2)):
        assert found.actions(episode).tobytes() == original.actions(old).tobytes()
        for name, poses in original.steps(old).bodies.items():
            np.testing.assert_array_equal(found.steps(episode).bodies[name], poses)
    decided = read_decisions(root)
    assert {d.candidate for d in decided} == {"ep-0002", "ep-0003", "never-rendered"}
    assert decided == [d for d in read_decisions(source) if d.candidate in {d.candidate for d in decided}]
    assert [(r.stage, r.entered, r.kept) for r in count_stages(decided)] == [
        ("collect", 3, 2),
        ("annotate", 2, 1),
    ]
    votes = read_votes(root / FOLDER / "votes")
    assert [r["uid"] for r in votes["ann"]] == ["ann-2-11", "ann-2-13", "ann-3-12"]
    assert ballot(votes["ann"], 1).votes["ep-0002"].step == 13
    assert ballot(votes["bob"], 1).revealed == {"ep-0003"}
    assert (root / FOLDER / "examples" / "move.png").read_bytes() == b"png"

    before = files_of(root)
    assert main(arguments) == 0
    assert files_of(root) == before, "a second repair changes nothing"


def test_parts_joined_again_have_what_the_whole_had(source, tmp_path):
    parts = [edited(source, tmp_path / name, rows) for name, rows in (("x", [0, 2]), ("y", [1, 3, 4]))]
    for part in parts:
        repair_dataset(part, [str(source)])
    whole = edited(source, tmp_path / "whole", [0, 2, 1, 3, 4])
    repair_dataset(whole, [str(p) for p in parts])
    assert set(read_candidates(whole).by_id) == set(read_candidates(source).by_id)
    assert set(read_decisions(whole)) == set(read_decisions(source))
    for name, records in read_votes(source / FOLDER / "votes").items():
        again = read_votes(whole / FOLDER / "votes")[name]
        assert ballot(again, 1).votes == ballot(records, 1).votes


def test_votes_made_since_stay_and_win(source, tmp_path):
    root = edited(source, tmp_path / "set", [2, 3])
    repair_dataset(root, [str(source)])
    cast(root, "ann", vote("ann", 2, 17))
    repair_dataset(root, [str(source)])
    votes = read_votes(root / FOLDER / "votes")["ann"]
    assert ballot(votes, 1).votes["ep-0002"].step == 17
    assert len(votes) == 4


def test_what_would_be_lost_or_cannot_be_ordered_is_refused_by_name(source, tmp_path):
    root = edited(source, tmp_path / "set", [2, 3])
    cast(root, "ann", vote("ann", 4, 9))
    before = files_of(root)
    with pytest.raises(
        ScenarioError, match=r"ann\.jsonl: votes of ann on ep-0004, whose episode is not here"
    ):
        repair_dataset(root, [str(source)])
    assert files_of(root) == before

    root = edited(source, tmp_path / "other", [2, 3])
    cast(root, "ann", vote("ann", 2, 18))
    with pytest.raises(ScenarioError, match="votes of ann on ep-0002 differ from another source's"):
        repair_dataset(root, [str(source)])

    root = edited(source, tmp_path / "decided", [2, 3])
    record_decisions(root, [Decision("ep-0004", "annotate", "kept")])
    with pytest.raises(ScenarioError, match="decision of annotate on ep-0004, whose episode is not here"):
        repair_dataset(root, [str(source)])

    root = edited(source, tmp_path / "busy", [2, 3])
    repair_dataset(root, [str(source)])
    cast(source_copy := Path(shutil.copytree(source, tmp_path / "copy")), "ann", vote("ann", 2, 19))
    book = VoteJournal(root / FOLDER / "votes", "ann", 1)
    try:
        with pytest.raises(ScenarioError, match="in use by another process"):
            repair_dataset(root, [str(source_copy)])
    finally:
        book.close()


def test_episodes_of_no_source_and_twice_and_lost_frames_are_refused(source, tmp_path):
    root = edited(source, tmp_path / "set", [0, 1])
    other = candidate_dataset(tmp_path / "other", 2, steps=STEPS)
    with pytest.raises(ScenarioError, match="episode 0: 0 candidates of the sources have these actions"):
        repair_dataset(edited(source, tmp_path / "x", [2, 1]), [str(other)])
    with pytest.raises(ScenarioError, match="some sources are candidate datasets and some are not"):
        repair_dataset(root, [str(source), str(tmp_path)])
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path).to_pydict()
    table["videos/observation.images.top/to_timestamp"][1] -= 0.05
    pq.write_table(pa.table(table), path)
    with pytest.raises(ScenarioError, match=r"episode 1, camera observation.images.top: 44 video frames"):
        repair_dataset(root, [str(source)])
    assert not (root / FOLDER).exists()


def test_the_candidates_file_stays_readable_json(source, tmp_path):
    root = edited(source, tmp_path / "set", [4])
    repair_dataset(root, [str(source)])
    document = json.loads((root / FOLDER / "candidates.json").read_text())
    assert [c["id"] for c in document["candidates"]] == ["ep-0004"]
