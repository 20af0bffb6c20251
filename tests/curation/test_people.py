"""What publishing tells of the people who made a dataset, and what of it --anonymise leaves out."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from lerobot_roborecover.curation.annotation.votes import Vote, VoteJournal, votes_folder
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.funnel import Decision, count_stages, read_decisions, record_decisions
from lerobot_roborecover.curation.people import INSPECTION, anonymise, find_people
from lerobot_roborecover.curation.resolution import ResolutionConfig, resolve, write_resolution
from lerobot_roborecover.datasets import load_scenarios, write_scenarios
from lerobot_roborecover.datasets.frames import LastFrames
from lerobot_roborecover.scenario import ScenarioError
from tests.support.candidate_files import candidate_dataset
from tests.support.factories import fake_scenario
from tests.support.hub_client import REPO, commit_of
from tests.support.release_files import files_of

NAMES = ("alice", "bobby", "carol")
SECRETS = (*NAMES, "my boss says", "too fast for me")


def vote_on(root, step=20):
    for n, name in enumerate(NAMES):
        book = VoteJournal(votes_folder(root, None), name, 1)
        for i in range(3):
            comment = "my boss says so" if n == 0 else ""
            book.add(
                Vote(f"uid-{9 - n}-{i:06d}", f"ep-{i:04d}", "recovery", step + n, "Move", "Wrong Pose",
                     comment=comment, seconds=12.5 + i)
            )  # fmt: skip
        book.close()


@pytest.fixture
def annotated(tmp_path):
    """Candidates with three people's votes and a program's, and the scenarios they resolve to."""
    root = candidate_dataset(tmp_path / "candidates", 5)
    vote_on(root)
    book = VoteJournal(votes_folder(root, None), "auto-1", 1)
    book.add(
        Vote("uid-auto-0001", "ep-0000", "recovery", 20, "Move", "Wrong Pose", comment="rule 3", seconds=1.0)
    )
    book.close()
    candidates = read_candidates(root)
    config = ResolutionConfig(annotators=3)
    found = resolve_three(candidates, root, config)
    write_resolution(tmp_path / "set", candidates, found, config, license="mit")
    record_decisions(
        tmp_path / "set", [Decision("ep-0001", "validate", "dropped", INSPECTION, "too fast for me", "bobby")]
    )
    return root, tmp_path / "set"


def resolve_three(candidates, root, config):
    auto = votes_folder(root, None) / "auto-1.jsonl"
    kept = auto.read_bytes()
    auto.unlink()
    found = resolve(candidates, votes_folder(root, None), config)
    auto.write_bytes(kept)
    return found


def texts(root):
    """Everything in a dataset's own files, pictures and video left out; parquet uncompressed."""
    found = {
        n: d.decode("utf-8", "replace") for n, d in files_of(root).items() if n.endswith((".json", ".jsonl"))
    }
    if (root / "meta/roborecover/scenarios.parquet").exists():
        found["provenance"] = json.dumps([s.provenance for s in load_scenarios(root)])
    return found | {"names": " ".join(files_of(root))}


def test_what_is_said_of_people_is_counted(annotated):
    candidates, scenarios = map(find_people, annotated)
    assert set(candidates.names) == set(scenarios.names) == set(NAMES)
    assert (candidates.votes, candidates.seconds, candidates.comments) == (9, 9, 3)
    assert candidates.times == 9 + candidates.decisions
    assert (scenarios.votes, scenarios.comments) == (9, 3 + 1)
    assert candidates.operators == ("noise",)  # the fifth is human-made
    line = candidates.lines(anonymised=False)[0]
    assert all(word in line for word in ("PUBLISHED", *NAMES, "3 comments", "9 working times", "--anonymise"))


def test_the_copy_says_nothing_of_them_and_all_else_the_same(annotated, tmp_path):
    for root in annotated:
        before = files_of(root)
        people = find_people(root)
        copy = tmp_path / f"copy-{root.name}"
        assert anonymise(root, copy, people) == []
        assert files_of(root) == before
        for name, text in texts(copy).items():
            assert not any(secret in text for secret in SECRETS), name
        again = find_people(copy)
        assert set(again.names) == {"annotator-1", "annotator-2", "annotator-3"}
        assert (again.votes, again.decisions) == (people.votes, people.decisions)
        assert again.times == again.seconds == again.comments == 0
        # The pseudonyms' order is that of the votes' random numbers, not of the names.
        assert people.names == ("carol", "bobby", "alice")
        assert count_stages(read_decisions(copy)) == count_stages(read_decisions(root))
    root, copy = annotated[0], tmp_path / "copy-candidates"
    auto = "meta/roborecover/votes/auto-1.jsonl"
    assert (copy / auto).read_bytes() == (root / auto).read_bytes()
    # The votes say the same as before.
    config = ResolutionConfig(annotators=3)
    mine, theirs = (resolve_three(read_candidates(r), r, config).candidates for r in (root, copy))
    assert [(r.outcome, r.step, r.stage) for r in mine] == [(r.outcome, r.step, r.stage) for r in theirs]
    a, b = (load_scenarios(r) for r in (annotated[1], tmp_path / "copy-set"))
    assert [s.sha256() for s in a] == [s.sha256() for s in b]
    assert [s.provenance["annotation"]["kind"] for s in b] == ["people"] * len(a)


def test_last_frames_go_along(tmp_path):
    scenario = fake_scenario(0)
    vote = {"annotator": "alice", "uid": "uid-00000001", "comment": "hm", "seconds": 3.0, "at": "2026"}
    scenario = replace(scenario, provenance={"annotation": {"votes": [vote]}})
    png = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + (8).to_bytes(4) + (8).to_bytes(4) + bytes(30)
    frames = [LastFrames(scenario.id, scenario.sha256(), 10, {"observation.image": (png,)})]
    write_scenarios(tmp_path / "set", [scenario], frames=frames, license="mit", description="mine")
    anonymise(tmp_path / "set", tmp_path / "copy", find_people(tmp_path / "set"))
    names = set(files_of(tmp_path / "copy"))
    assert names == set(files_of(tmp_path / "set"))
    assert load_scenarios(tmp_path / "copy").manifest["description"] == "mine"
    (cast,) = load_scenarios(tmp_path / "copy")[0].provenance["annotation"]["votes"]
    assert cast == {
        "annotator": "annotator-1",
        "uid": "uid-00000001",
        "comment": "",
        "seconds": 0.0,
        "at": "",
    }


def test_a_name_that_stays_is_said_and_a_pseudonym_is_not_taken_twice(annotated, tmp_path):
    root = annotated[0]
    (root / "README.md").write_text("With thanks to alice and to malice.")
    assert anonymise(root, tmp_path / "one", find_people(root)) == ["README.md"]
    votes = votes_folder(root, None)
    VoteJournal(votes, "annotator-2", 1).close()
    (votes / "annotator-2.jsonl").write_bytes((votes / "alice.jsonl").read_bytes())
    (votes / "alice.jsonl").unlink()
    (votes / "carol.jsonl").unlink()
    assert "annotator-2" in find_people(root).names
    anonymise(root, tmp_path / "two", find_people(root))
    assert len(list((tmp_path / "two/meta/roborecover/votes").iterdir())) == 3


def test_a_dataset_without_people_says_nothing(tmp_path):
    write_scenarios(tmp_path / "set", [fake_scenario(0)])
    assert not find_people(tmp_path / "set")
    assert find_people(tmp_path / "set").lines(anonymised=False) == []
    (tmp_path / "set/meta/roborecover/votes").mkdir()
    (tmp_path / "set/meta/roborecover/votes/alice.jsonl").write_text("{}\n")
    with pytest.raises(ScenarioError, match="line 1, field schema"):
        find_people(tmp_path / "set")


@pytest.mark.slow
def test_publish_says_it_before_anything_is_uploaded_and_leaves_it_out_when_asked(hub, client, annotated):
    root = annotated[1]
    shown = client.publish(root, "--dry-run").stdout
    assert "people    PUBLISHED with it: names (" in shown
    assert all(name in shown for name in NAMES)
    done = client.publish(root, "--anonymise")
    assert "people    left out: names (" in done.stdout
    assert f"dataset   {root}, anonymised" in done.stdout
    files = hub.repos[REPO].commits[commit_of(done)]
    for data in files.values():
        assert not any(secret.encode() in data for secret in SECRETS)
    assert b"annotator-1" in files["meta/roborecover/decisions.jsonl"]
    assert not list(root.parent.glob(".anonymised-*"))
    assert "alice" in (root / "meta/roborecover/decisions.jsonl").read_text()
    # The same again is nothing new.
    again = client.publish(root, "--anonymise")
    assert "upload    0 files" in again.stdout
    assert "earlier commits of the repository keep what they hold" in again.stdout
