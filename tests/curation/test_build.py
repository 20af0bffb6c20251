"""The chain from one file: what is refused, what runs again, and that it can be stopped anywhere."""

from __future__ import annotations

import shutil
from dataclasses import asdict, fields
from pathlib import Path

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.annotation.votes import SCHEMA_VERSION as VOTES_SCHEMA
from lerobot_roborecover.curation.annotation.votes import Vote
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.collect.collection import Collected
from lerobot_roborecover.curation.funnel import Decision, StageCounts, record_decisions
from lerobot_roborecover.curation.pipeline.config import CollectPart, ScreenPart, ValidatePart, read_config
from lerobot_roborecover.curation.pipeline.requests import collect_options
from lerobot_roborecover.curation.pipeline.stages import AwaitingAnnotations, Pipeline, _key, _options
from lerobot_roborecover.curation.pipeline.summary import markdown
from lerobot_roborecover.curation.pipeline.work import StageRunners
from lerobot_roborecover.curation.split import SplitConfig
from lerobot_roborecover.datasets import read_scenarios
from lerobot_roborecover.datasets.video_frames import check_frames
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.journal import Journal
from tests.support.build_files import FAKE, WHOLE, changed, write

EXAMPLE = Path(__file__).parents[2] / "policies" / "build" / "metaworld.yaml"


@pytest.mark.lerobot
@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("colect", {}, "unknown key colect; did you mean collect?"),
        ("screen.trails", 5, "unknown key screen.trails; did you mean trials"),
        ("collect.biased.perturbed", True, "unknown key collect.biased.perturbed; did you mean perturb"),
        ("publish.repo", "a/b", "unknown key publish.repo; did you mean repo_id"),
        ("out", None, "out is missing"),
        ("platform", "mars", "'mars' is not one of libero"),
        ("collect", {}, "collect is empty"),
        ("collect.biased.policy", "p", "give one of dataset, policy and expert"),
        ("collect.shaken", {"dataset": "d", "draw": 3}, "leave out draw"),
        ("collect.a/b", {"expert": "x"}, "a name is letters"),
        ("screen.policies", None, "screen.policies is empty"),
        ("screen.policies", [{"name": "a"}], "path is missing"),
        ("screen.policies", [{"path": "a", "options": {"k": 1}}], "need a name"),
        ("screen.policies", [{"pth": "a"}], "unknown key screen.policies.0.pth; did you mean path"),
        ("screen.keep", [1], "two numbers"),
        ("screen.trials", "many", "trials"),
        ("split.sizes", {"train": 1}, "at least two splits"),
        (
            "annotate.no_consensus",
            "vote",
            "annotate.no_consensus`: Cannot convert 'vote' (<class 'str'>) into one of: discuss, drop",
        ),
        ("publish", {}, "repo_id is missing"),
    ],
)
def test_files_that_are_refused(tmp_path, key, value, words):
    with pytest.raises(OptionError, match=r"build\.yaml") as caught:
        read_config(write(tmp_path / "build.yaml", changed(WHOLE, key, value)))
    assert words in str(caught.value), str(caught.value)


@pytest.mark.lerobot
def test_the_example_can_be_read_and_tried(tmp_path, monkeypatch, capsys):
    read_config(write(tmp_path / "whole.yaml", WHOLE))
    config = read_config(EXAMPLE)
    assert config.split.sizes == {"train": 0.8, "test": 0.2}
    monkeypatch.chdir(tmp_path)
    assert main(["build", str(EXAMPLE), "--dry-run"]) == 2, "its checkpoints are not here"
    said = capsys.readouterr()
    assert said.out.count("would run") == 9
    assert "[stage 4 of 9, 0:00:0" in said.out
    assert said.err.count("pretrained_model") >= 3
    for text, words in (("- a\n", "not a map"), ("a: [", "not YAML")):
        (tmp_path / "bad.yaml").write_text(text)
        with pytest.raises(OptionError, match=words):
            read_config(tmp_path / "bad.yaml")
    chain = Pipeline(config, StageRunners())
    with pytest.raises(OptionError, match="--from nowhere: not one of"):
        chain.build("nowhere")
    with pytest.raises(OptionError, match="come in the order"):
        chain.build("split", "collect")


def test_the_funnel_as_markdown():
    text = markdown([StageCounts("collect", 5, 3, (("stuck | jammed", 2),), 0)])
    assert "| collect | 5 | 3 | 2 | 0 |" in text
    assert "| collect | 2 | stuck / jammed |" in text


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """A chain whose stages only make their folders, and whose candidates are there."""
    from tests.support.candidate_files import candidate_dataset

    monkeypatch.setattr(
        "lerobot_roborecover.curation.pipeline.stages.merge_candidates",
        lambda folder, sources: shutil.copytree(sources[0], folder),
    )
    candidate_dataset(tmp_path / "rollouts", 3)
    content = {
        "out": str(tmp_path / "out"), "platform": "fake",
        "collect": {"mine": {"dataset": str(tmp_path / "rollouts")}},
        "screen": {"policies": [{"path": "p"}]}, "split": {"sizes": {"train": 0.5, "test": 0.5}},
    }  # fmt: skip
    asked: dict[str, tuple] = {}

    def stand_in(name: str):
        def work(*given) -> None:
            asked[name] = given
            if name in build.broken:
                raise OptionError("it cannot")
            out = given[2] if name == "split" else getattr(given[0], "out", None)
            if out is not None and name not in build.empty:
                out.mkdir()

        return work

    def build(*args, content=content, **kwargs) -> list[str]:
        asked.clear()
        config = read_config(write(tmp_path / "build.yaml", content))
        work = StageRunners(**{f.name: stand_in(f.name) for f in fields(StageRunners)})
        Pipeline(config, work, lambda line: None).build(*args, **kwargs)
        return list(asked)

    build.root, build.content, build.asked = tmp_path / "out", content, asked
    build.broken, build.empty = set(), set()
    return build


@pytest.mark.parametrize("part", [CollectPart, ScreenPart, ValidatePart])
def test_a_place_is_no_part_of_what_a_stage_makes(part):
    assert _options(part(engine="ray", ray_address="head:6379")) == _options(part())


@pytest.mark.slow
def test_what_runs_again(stand_in):
    build = stand_in
    with pytest.raises(AwaitingAnnotations, match=r"3 candidates wait for votes \(3 each\)"):
        build()
    with pytest.raises(AwaitingAnnotations):
        build()
    assert not (build.root / "old").exists(), "what is unchanged is left alone while people are waited for"
    assert vote_for_all(build.root) == 3
    assert build(dry_run=True) == []
    assert build("", "agree") == ["agree"]
    assert build() == ["screen", "validate", "split", "render"]
    screened = build.asked["screen"][0]
    assert (screened.dataset, screened.out) == (str(build.root / "scenarios"), build.root / "screened")
    assert [policy.path for policy in screened.policies] == ["p"]
    assert build.asked["split"][:3] == (
        build.root / "validated", SplitConfig({"train": 0.5, "test": 0.5}), build.root / "split",
    )  # fmt: skip
    assert build() == []
    assert build("validate") == ["validate", "split", "render"]
    assert build("", "screen") == []
    seed = changed(build.content, "split.seed", 7)
    assert build(content=seed) == ["split", "render"]
    assert build.asked["split"][1].seed == 7
    assert build(content=changed(seed, "screen.num_workers", 9)) == [], "a pace is no change"
    for key, value in (("screen.engine", "local"), ("validate.ray_address", "head:6379")):
        assert build(content=changed(seed, key, value)) == [], "nor is a place"
    assert build(content=changed(seed, "screen.keep", [2, 18])) == ["screen", "validate", "split", "render"]
    assert build.asked["screen"][0].rule.keep == ("2", "18")
    assert build(content=changed(seed, "screen.keep", [0.1, 0.9])) == [
        "screen",
        "validate",
        "split",
        "render",
    ]
    assert build.asked["screen"][0].rule.keep == ("0.1", "0.9")
    build(content=seed)
    assert build(content=changed(seed, "publish.repo_id", "a/b"))[-1] == "publish"
    # Votes, rejections and decisions of people count; a result that is gone is made again.
    content = changed(seed, "publish.repo_id", "a/b")
    with Journal(build.root / "votes" / "ann.jsonl", VOTES_SCHEMA) as journal:
        journal.append(vote("ep-0000", "ann") | {"uid": "second-thoughts"})
    assert build(content=content) == ["agree", "screen", "validate", "split", "render", "publish"]
    with Journal(build.root / "validated.replays" / "rejects.jsonl", 1) as journal:
        journal.append({"id": "ep-0000", "rejected": True})
    assert build(content=content) == ["validate", "split", "render", "publish"]
    shutil.rmtree(build.root / "split")
    assert build(content=content) == ["split", "render", "publish"]
    shutil.rmtree(build.root / "screened")  # and with it all that was made of it, though no option changed
    assert build(content=content, dry_run=True) == []
    assert build(content=content) == ["screen", "validate", "split", "render", "publish"]
    record_decisions(
        Path(content["collect"]["mine"]["dataset"]), [Decision("ep-0001", "collect", "dropped", "x")]
    )
    assert build(content=content) == ["agree", "screen", "validate", "split", "render", "publish"]
    assert len(list((build.root / "old").iterdir())) > 5, "nothing is deleted"
    assert build(content=content) == []


def test_a_stage_that_ends_in_an_error_is_not_recorded(stand_in):
    build = stand_in
    with pytest.raises(AwaitingAnnotations):
        build()
    vote_for_all(build.root)
    build.broken = {"agree"}
    with pytest.raises(
        ScenarioError, match=r"^agree: it cannot\. What had finished is kept: run build again$"
    ):
        build()
    build.broken = set()
    assert build() == ["agree", "screen", "validate", "split", "render"]
    with Journal(build.root / "stages.jsonl", 1), pytest.raises(ScenarioError, match="in use by another"):
        build()


def test_rollouts_of_which_nothing_is_kept_do_not_end_a_build(stand_in, monkeypatch, capsys):
    """The other ways may still give candidates."""
    build = stand_in
    content = changed(build.content, "collect.none", {"expert": "expert_biased", "draw": 1})
    build.empty = {"collect"}
    with pytest.raises(AwaitingAnnotations, match="3 candidates wait"):
        build(content=content)
    options = build.asked["collect"][0]
    assert options.out == build.root / "collect" / "none"
    nothing = Collected(None, (), 0)
    monkeypatch.setattr("lerobot_roborecover.curation.collect.collection.collect", lambda *_: nothing)
    lines: list[str] = []
    StageRunners().collect(options, lines.append)
    assert "no rollout was kept" in lines[0]


KEYS = {
    "collect shaken": "4e9e296ce235078c",
    "join": "b8d04bb8dbad67dc",
    "annotate": "19a5744229e8c820",
    "agree": "2eae0a3c09eab43d",
    "screen": "776cc8b37f2e9d69",
    "validate": "6ad608f972dece81",
    "split": "9f33d9939329298f",
    "render": "87b09115984adca6",
    "publish": "65b98dfdfc5ab7f2",
}
"""By stage: the beginning of what was written into `stages.jsonl`."""


@pytest.mark.lerobot
def test_a_build_of_an_earlier_version_is_up_to_date(tmp_path):
    content = {
        "out": "nowhere/out", "platform": "fake",
        "collect": {
            "shaken": {
                "expert": "expert_biased", "task": ["push-*"], "draw": 4, "perturb": True, "frames": 32,
            },
        },
        "screen": {
            "policies": [{"path": "nowhere/act", "name": "act", "options": {"n_action_steps": 5}}],
            "trials": 2, "keep": [0.1, 0.9],
        },
        "validate": {"runs": 2, "num_workers": 2}, "split": {"sizes": {"train": 0.5, "test": 0.5}, "seed": 7},
        "render": {"frames": 64}, "publish": {"repo_id": "org/name"},
    }  # fmt: skip
    config = read_config(write(tmp_path / "build.yaml", content))
    found, key = {}, ""
    for stage in Pipeline(config, StageRunners())._stages():
        key = _key(key, stage)
        found[stage.label] = key[:16]
    assert found == KEYS
    options = collect_options(config, "shaken", config.collect["shaken"], Path("out/shaken"))
    assert options.work == Path("out/shaken.work-766c56a0"), "rollouts that are there are used again"


def vote_for_all(root: Path) -> int:
    """Three annotators mark the same everywhere; the last one discards the first candidate, alone."""
    candidates = read_candidates(root / "candidates")
    for name in ("ann", "bob", "cleo"):
        with Journal(root / "votes" / f"{name}.jsonl", VOTES_SCHEMA) as journal:
            journal.append(*(vote(c.id, name) for c in candidates.candidates))
    return len(candidates)


def vote(candidate: str, name: str) -> dict:
    made = Vote(
        f"{name}-{candidate}", candidate, "recovery", 12, "Approach", "Wrong Pose", annotator=name,
        at="2026-01-02T03:04:05+00:00",
    )  # fmt: skip
    return {"kind": "vote", **asdict(made)}


@pytest.fixture
def build(tmp_path, monkeypatch):
    """Runs the command with a content; counts what was loaded."""
    from tests.support.push_checkpoints import load_push_host, push_checkpoints

    loads = []
    monkeypatch.setattr(
        "lerobot_roborecover.evaluation.loading.load_host", lambda c: loads.append(c) or load_push_host(c)
    )
    policies = [{"path": str(p), "name": p.name} for p in push_checkpoints(tmp_path / "policies")[:2]]
    whole = {**FAKE, "out": str(tmp_path / "out"), "screen": {**FAKE["screen"], "policies": policies}}

    def run(*args: str, content: dict = whole) -> int:
        return main(["build", str(write(tmp_path / "build.yaml", content)), *args])

    run.whole, run.loads, run.root = whole, loads, tmp_path / "out"
    return run


def ran(text: str) -> list[str]:
    return [line[line.index("] ") + 2 : -6] for line in text.splitlines() if line.endswith(": runs")]


def whole_build(build, capsys) -> list:
    """From rollouts to episodes, with people in between; its scenarios."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    assert build("--until", "collect") == 0
    assert ran(capsys.readouterr().out) == ["collect biased", "collect shaken"]
    # People are waited for, as often as it takes.
    for _ in range(2):
        assert build() == 1
        text = capsys.readouterr().out
        assert "wait for votes (3 each)" in text
    assert ran(text) == ["annotate"]
    count = vote_for_all(build.root)
    assert build() == 0
    text = capsys.readouterr().out
    assert ran(text) == ["annotate", "agree", "screen", "validate", "split", "render"]
    assert f"to publish: roborecover dataset publish {build.root / 'rendered'} --repo-id ORG/NAME" in text
    final = read_scenarios(build.root / "split")
    assert 4 <= len(final) <= count
    assert {s.split for s in final} == {"train", "test"}
    for scenario in final:
        assert set(scenario.provenance) >= {"annotation", "screening", "validation", "rollout"}
        assert scenario.provenance["validation"]["mean_ssim"] > 0.99
    rendered = LeRobotDataset("lab/rendered", root=build.root / "rendered")
    assert rendered.num_episodes == len(final)
    assert check_frames(build.root / "rendered", [len(s.prefix) for s in final], thorough=True)
    assert [s.sha256() for s in read_scenarios(build.root / "rendered")] == [s.sha256() for s in final]
    funnel = (build.root / "summary" / "funnel.md").read_text()
    for stage in ("collect", "annotate", "screen", "validate", "split"):
        assert f"| {stage} |" in funnel
    assert (build.root / "summary" / "build.yaml").is_file()
    assert "leakage by trajectory: none" in (build.root / "summary" / "splits.txt").read_text()
    return final


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
def test_from_rollouts_to_episodes(build, capsys):
    whole_build(build, capsys)
    # Nothing has changed, nothing runs; a faster pace is no change.
    assert build(content=changed(build.whole, "validate.num_workers", 1)) == 0
    assert ran(capsys.readouterr().out) == []


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
def test_what_is_changed_is_made_anew(build, capsys):
    final = whole_build(build, capsys)
    loads = len(build.loads)
    # What is changed is made anew, with all after it, from the trials and replays that are there.
    replays = (build.root / "validated.replays" / "replays.jsonl").read_bytes()
    assert build(content=changed(build.whole, "screen.max_invalid", 1)) == 0
    text = capsys.readouterr().out
    assert ran(text) == ["screen", "validate", "split", "render"]
    assert len(build.loads) == loads, "no trial runs again"
    assert (build.root / "validated.replays" / "replays.jsonl").read_bytes() == replays
    assert sorted(p.name for p in (build.root / "old").iterdir()) == [
        "rendered-1",
        "screened-1",
        "split-1",
        "validated-1",
    ]
    assert build("--from", "split", content=changed(build.whole, "screen.max_invalid", 1)) == 0
    assert ran(capsys.readouterr().out) == ["split", "render"]
    # A later vote counts.
    with Journal(build.root / "votes" / "ann.jsonl", VOTES_SCHEMA) as journal:
        journal.append(vote(final[0].id, "ann") | {"uid": "second-thoughts"})
    assert build("--until", "agree", content=changed(build.whole, "screen.max_invalid", 1)) == 0
    assert ran(capsys.readouterr().out) == ["agree"]
