"""What is found before a build's first stage, and that every command which names another names one that its
parser accepts."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_roborecover.cli.main import build_parser, main
from lerobot_roborecover.curation.pipeline.check import check_build
from lerobot_roborecover.curation.pipeline.config import read_config
from lerobot_roborecover.curation.pipeline.stages import AwaitingAnnotations, BuildEta, Pipeline
from lerobot_roborecover.curation.pipeline.work import StageRunners
from lerobot_roborecover.curation.render import RenderRequest, render
from lerobot_roborecover.curation.screen.dataset import validate_next
from lerobot_roborecover.curation.validate.dataset import reject_next
from lerobot_roborecover.curation.validate.request import ValidationRequest
from lerobot_roborecover.datasets import read_scenarios, write_scenarios
from lerobot_roborecover.datasets.video_frames import check_frames
from lerobot_roborecover.datasets.write import write_episodes
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.text import format_duration, next_command, pluralize
from tests.curation.test_build import FAKE, changed, write
from tests.support.candidate_files import candidate_dataset
from tests.support.factories import fake_dataset, fake_scenario, save_policy


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return save_policy(tmp_path_factory.mktemp("policies") / "act")


@pytest.fixture
def problems(tmp_path, policy):
    """What stands against a build that is well but for one entry."""
    good = {
        **FAKE, "out": str(tmp_path / "out"),
        "screen": {**FAKE["screen"], "policies": [{"path": str(policy)}]},
    }  # fmt: skip

    def check(key: str = "", value=None) -> list[str]:
        content = changed(good, key, value) if key else good
        return check_build(read_config(write(tmp_path / "build.yaml", content)))

    check.good, check.root = good, tmp_path
    return check


@pytest.mark.lerobot
@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("screen.keep", [3, 99], "screen.keep: keep 3 to 99"),
        ("screen.keep", [0.9, 0.1], "screen.keep: keep 0.9 to 0.1: neither two counts"),
        (
            "screen.policies",
            [{"path": "nowhere/at-all"}],
            "screen.policies.0: --policy.path=nowhere/at-all: no LeRobot policy there",
        ),
        ("screen.env", {"obs_typ": "state"}, "screen: "),
        ("screen.env", {"start": "initial"}, "screen: --env start=initial: screening settles this itself"),
        ("screen.policies", [{"path": "p", "name": "a b"}], "screen: policy name 'a b' is not"),
        ("collect.biased.frames", 33, "frames: 33; video has an even side"),
        ("collect.biased.frames", 48, "frame sizes differ (biased 48 x 48, shaken 32 x 32)"),
        ("collect.biased.frames", "none", "collect.biased.frames: none"),
        ("collect.biased.frames", 8, "collect.biased: --frames=8"),
        ("collect.biased.expert", "nobody", "collect.biased: --expert 'nobody'"),
        ("collect.more", {"dataset": "nowhere"}, "collect.more: nowhere is not a candidate dataset"),
        ("collect.biased.seeds", "a-b", "collect.biased: "),
        ("validate.min_ssim", 2, "validate: 2 runs"),
        ("collect.biased.engine", "foo", "collect.biased: --engine=foo: not one of ['local', 'ray']"),
        ("screen.engine", "foo", "screen: --engine=foo"),
        ("validate.engine", "foo", "validate: --engine=foo"),
        ("validate.rejects", "nowhere.txt", "validate: rejects nowhere.txt is not there"),
        ("split.sizes", {"train": 0.5, "test": 0.6}, "split: fractions"),
        ("split.disjoint_by", "colour", "split: "),
        ("render.frames", 33, "render: frames 33"),
        ("render.env", {"nothing": 1}, "render: env: there is no option --env.nothing"),
        ("publish", {"repo_id": "no slash"}, "publish: repo_id 'no slash' is not like ORG/NAME"),
        ("publish", {"repo_id": "a/b"}, "publish: no licence"),
    ],
)
def test_what_is_found_before_anything_runs(problems, monkeypatch, key, value, words):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    assert any(words in problem for problem in problems(key, value)), problems(key, value)


@pytest.mark.lerobot
def test_programs_annotate_without_frames(problems):
    problems.good["annotate"] = {**problems.good.get("annotate", {}), "automatic": True}
    parts = problems.good["collect"].items()
    problems.good["collect"] = {name: {**part, "frames": "none"} for name, part in parts}
    assert any("no frames to compare replays with" in p for p in problems())
    problems.good["validate"] = {**problems.good.get("validate", {}), "no_frames": True}
    assert not [p for p in problems() if "frame" in p]
    assert any("frame sizes differ" in p for p in problems("collect.biased.frames", 32))


@pytest.mark.lerobot
def test_a_build_that_can_run_has_no_problems_and_all_are_told_at_once(problems, policy):
    assert problems() == []
    votes = problems.root / "votes"
    votes.mkdir()
    (votes / "Ann Other.jsonl").touch()
    (problems.root / "out").write_text("a file")
    found = problems("annotate.votes", str(votes))
    assert len(found) == 2
    assert "annotator 'Ann Other' is not" in found[1]
    assert "is no folder that you may write to" in found[0]


@pytest.mark.lerobot
def test_weights_that_were_cut_off_are_found(problems, tmp_path):
    cut = save_policy(tmp_path / "cut")
    file = cut / "model.safetensors"
    file.write_bytes(file.read_bytes()[:-100])
    (found,) = problems("screen.policies", [{"path": str(cut)}])
    assert f"{cut}: model.safetensors has" in found
    assert "it was cut" in found


@pytest.mark.lerobot
def test_a_curtailed_screening_leaves_enough_to_validate_with(problems):
    screen = {**problems.good["screen"], "early_stop": True}
    found = problems("screen", screen)
    assert not any("early_stop" in line for line in found)
    problems.good["validate"] = {**problems.good.get("validate", {}), "runs": 4}
    (line,) = [line for line in problems("screen", screen) if "early_stop" in line]
    assert line.startswith("validate: runs 4: with screen.early_stop a scenario may have only 3 trials")


@pytest.mark.lerobot
def test_the_command_runs_nothing_where_something_stands_against_it(problems, tmp_path, capsys):
    path = write(tmp_path / "bad.yaml", changed(problems.good, "split.sizes", {"train": 0.5, "test": 0.6}))
    assert main(["build", str(path)]) == 2
    said = capsys.readouterr()
    assert "cannot be built, and nothing was run" in said.err
    assert "split: fractions" in said.err
    assert not (tmp_path / "out").exists()


def test_how_far_a_build_is():
    pace = BuildEta(["collect a", "join", "split"], {"join": 61.0})
    assert re.fullmatch(
        r"\[stage 2 of 3, 0:00:0\d elapsed, left at most: about 0:01:01 and 1 stage never timed\]",
        pace.at("join"),
    )
    assert "left at most: not known yet" in pace.at("split")


def accepted(line: str) -> list[str]:
    """The command of a line, after its parser has taken it."""
    _, _, command = line.partition("roborecover ")
    argv = shlex.split(command)
    if argv[1] != "collect":
        build_parser().parse_args(argv)
    return argv


def test_every_next_line_is_accepted_by_the_parser_of_its_command(tmp_path, monkeypatch, capsys):
    """Folders with blanks and quotes in their names included."""
    out = tmp_path / "my 'set'"
    bare = write_scenarios(out / "bare", [fake_scenario(0)])
    assert accepted(next_command(validate_next(bare, out / "trials")))[-4:] == [
        "--candidates", "CANDIDATES", "--out", "VALIDATED",
    ]  # fmt: skip
    request = ValidationRequest(
        dataset=bare,
        trials_folder=out / "trials",
        out=out / "validated",
        candidates=[out / "a", out / "b"],
        env=["obs_type=state"],
    )
    argv = accepted(f"roborecover {shlex.join(reject_next(request))}")
    args = build_parser().parse_args(argv)
    assert (args.dataset, args.candidates, args.reject) == (bare, [out / "a", out / "b"], ["ID"])
    assert (args.runs, args.seed, args.tolerance_mm, args.min_ssim) == (3, 42, 2.0, 0.99)

    assert main(["split", str(fake_dataset(out / "six", 6)), "--train", "4", "--test", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert accepted(next(line for line in lines if line.startswith("next: ")))[:3] == [
        "dataset", "render", str(out / "six"),
    ]  # fmt: skip


@pytest.mark.lerobot
def test_a_build_that_waits_names_a_command_that_is_accepted(tmp_path, monkeypatch):
    import shutil

    monkeypatch.setattr(
        "lerobot_roborecover.curation.pipeline.stages.merge_candidates",
        lambda folder, sources: shutil.copytree(sources[0], folder),
    )
    content = {
        "out": str(tmp_path / "my out"), "platform": "fake",
        "collect": {"mine": {"dataset": str(candidate_dataset(tmp_path / "rollouts", 1))}},
        "screen": {"policies": [{"path": "p"}]}, "split": {"sizes": {"train": 0.5, "test": 0.5}},
    }  # fmt: skip
    lines: list[str] = []
    work = StageRunners()
    chain = Pipeline(read_config(write(tmp_path / "b.yaml", content)), work, lines.append)
    with pytest.raises(AwaitingAnnotations, match="1 candidate waits for votes") as caught:
        chain.build()
    assert accepted(str(caught.value).splitlines()[-1])[:2] == ["curate", "annotate"]
    assert "1 candidate of 1 dataset in" in "\n".join(lines)
    assert [line for line in lines if line.endswith(": runs")][1].startswith("[stage 2 of 7, ")


def test_scripted_controllers_are_listed_without_an_out(capsys):
    assert main(["collect", "--expert", "?"]) == 0
    every = capsys.readouterr().out
    assert "metaworld" in every
    assert "libero" in every
    assert main(["collect", "--expert", "?", "--env.type=roborecover_fake"]) == 0
    assert "expert_biased" in (text := capsys.readouterr().out)
    assert "metaworld" not in text
    with pytest.raises(SystemExit):
        main(["collect", "--expert", "expert", "--env.type=roborecover_fake"])
    assert "required: --out" in capsys.readouterr().err


def test_numbers_of_things():
    assert [pluralize(n, "candidate") for n in (0, 1, 2)] == ["0 candidates", "1 candidate", "2 candidates"]
    assert pluralize(4, "screening policy") == "4 screening policies"
    assert format_duration(3725.4) == "1:02:05"


@pytest.mark.lerobot
@pytest.mark.nightly
def test_rendering_ends_in_a_lerobot_dataset_that_knows_what_was_decided(tmp_path, capsys):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_roborecover.curation.funnel import Decision, read_decisions, record_decisions

    scenarios = [fake_scenario(i, steps=5 + i) for i in range(2)]
    source = write_scenarios(tmp_path / "set", scenarios, description="two", license="mit")
    record_decisions(source, [Decision(s.id, "split", "kept") for s in scenarios])
    (source / "meta" / "roborecover" / "split.json").write_text(json.dumps({"seed": 1}))
    out = tmp_path / "rendered"
    assert main(["render", str(source), "--out", str(out), "--frames", "64"]) == 0
    said = capsys.readouterr()
    assert f"2 episodes in {out}" in said.out
    assert accepted(said.out.splitlines()[-1])[:3] == ["dataset", "publish", str(out)]
    dataset = LeRobotDataset("lab/x", root=out)
    assert (dataset.num_episodes, dataset.num_frames) == (2, 11)
    assert dataset[3]["observation.image"].shape == (3, 64, 64)
    assert check_frames(out, [5, 6], thorough=True) == 11
    assert [s.sha256() for s in read_scenarios(out)] == [s.sha256() for s in scenarios]
    assert read_decisions(out) == read_decisions(source)
    assert json.loads((out / "meta" / "roborecover" / "split.json").read_text()) == {"seed": 1}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rendered", "set"], "no leftovers"
    with pytest.raises(ScenarioError, match="not an empty folder"):
        render(RenderRequest(source, out))
    with pytest.raises(OptionError, match="frames 65"):
        render(RenderRequest(source, Path(tmp_path / "other"), 65))


@pytest.mark.lerobot
def test_writing_episodes_says_nothing_of_ffmpegs(tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("SVT_LOG", "1")
    write_episodes(
        tmp_path / "set", [fake_scenario(i, steps=4) for i in range(2)],
        lambda: make_simulator("fake", obs_type="pixels_agent_pos", observation_size=64),
    )  # fmt: skip
    assert "[mp4 @" not in capfd.readouterr().err


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
def test_a_commands_output_is_its_own(tmp_path):
    """In a process of its own, as a user runs it; two parts are written and joined."""
    source = write_scenarios(tmp_path / "set", [fake_scenario(i, steps=4) for i in range(11)])
    argv = ["dataset", "render", str(source), "--out", str(tmp_path / "out"), "--frames", "64"]
    command = [sys.executable, "-m", "lerobot_roborecover.cli.main", *argv]
    environment = {k: v for k, v in os.environ.items() if k not in ("SVT_LOG", "TQDM_DISABLE")}
    done = subprocess.run(command, capture_output=True, env=environment, check=True)
    assert done.stdout.decode().splitlines() == [
        f"11 episodes in {tmp_path / 'out'}",
        f"next: roborecover dataset publish {tmp_path / 'out'} --repo-id ORG/NAME",
    ]
    first, *_, last = done.stderr.decode().strip("\r\n").split("\r")
    assert first.startswith("  0%|")
    assert last.startswith("100%|")
    assert "2/2 [" in last
    assert done.stderr.count(b"\n") == 1, "a bar and nothing else"
