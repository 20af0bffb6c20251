"""Commands that keep trials in a folder of their own: another policy there is another policy."""

from __future__ import annotations

import json
import shutil

import pytest

from lerobot_roborecover.curation.screen.runs import PolicySpec, run_policy, take_trials
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.arms import claim_log, identity_of_run
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.scenario import ScenarioError
from recipes.study.arms import arms
from recipes.study.definition import StudyDefinition
from recipes.study.evaluate import run_of
from tests.support.factories import fake_dataset, save_policy
from tests.support.trial_rows import trial_row, write_log


@pytest.fixture
def checkpoint(tmp_path):
    folder = tmp_path / "act"
    folder.mkdir()
    (folder / "config.json").write_text("{}")
    (folder / "policy_preprocessor.json").write_text("{}")
    return folder


def test_a_log_of_another_policy_is_moved_aside(checkpoint, tmp_path):
    log, said = tmp_path / "run" / "trials.jsonl", []

    def claim():
        claim_log(log, identity_of_run("fake", {"path": str(checkpoint), "device": "cpu"}), said.append)

    log.parent.mkdir()
    claim()
    write_log(log, [trial_row(0)])
    before = log.read_bytes()
    claim()
    assert log.read_bytes() == before
    assert not said
    (checkpoint / "policy_preprocessor.json").write_text('{"statistics": 1}')
    claim()
    assert not log.exists()
    assert log.with_name("trials.jsonl.before-1").read_bytes() == before
    assert "are not reused" in said[0]
    write_log(log, [trial_row(1)])
    (log.parent / "identity.json").unlink()
    claim()
    assert log.with_name("trials.jsonl.before-2").exists(), "nothing says whose trials these are"


def test_a_study_is_not_finished_with_another_policy(checkpoint, tmp_path):
    (tmp_path / "policies").mkdir()
    shutil.move(checkpoint, tmp_path / "policies" / "act")
    study = StudyDefinition(tmp_path, "fake", {"act": 1}, "act")

    def ran(slots=0):
        return [run_of(arm, study, ["a"]) for arm in arms(study, tmp_path / "out", (), slots)]

    for run in ran():
        run.log.parent.mkdir(parents=True)
        run.log.with_name("done.json").write_text(json.dumps({**run._key(), "seconds": 1, "finished": True}))
    assert all(run.finished() for run in (*ran(), *ran(slots=3)))
    (tmp_path / "policies" / "act" / "policy_preprocessor.json").write_text("[]")
    assert not any(run.finished() for run in ran())


def test_a_reproduction_knows_its_policy(checkpoint, tmp_path):
    from dataclasses import replace
    from types import SimpleNamespace

    from lerobot_roborecover.reproduce.arms import ReproductionPlan

    config = tmp_path / "run.yaml"
    config.write_text(f"env: {{type: roborecover_fake}}\npolicy: {{path: {checkpoint}, n_action_steps: 2}}\n")
    plan = ReproductionPlan(SimpleNamespace(config=config, arguments=()), tmp_path / "out")  # ty: ignore
    before = plan.identity("initial")
    assert replace(plan, trials=9, arguments=("--runner.slots=3",)).identity("initial") == before
    assert replace(plan, arguments=("--policy.n_action_steps=1",)).identity("initial") != before
    (checkpoint / "policy_preprocessor.json").write_text("[]")
    assert plan.identity("initial") != before


def test_a_demo_of_another_policy_takes_another_folder(checkpoint, tmp_path):
    from lerobot_roborecover.demo import DemoError
    from lerobot_roborecover.demo.settings import DemoSettings, claim_folder

    settings = DemoSettings(out=tmp_path / "demo", policy=str(checkpoint))
    claim_folder(settings)
    claim_folder(settings)
    (checkpoint / "policy_preprocessor.json").write_text("[]")
    with pytest.raises(DemoError, match=r"holds a demo with identity 'act@.*Give this one a folder"):
        claim_folder(settings)


@pytest.mark.nightly
@pytest.mark.lerobot
def test_screening_runs_a_changed_policy_again_and_shows_it_alone(tmp_path):
    dataset = fake_dataset(tmp_path / "set", 2, horizon=6)
    policy = save_policy(tmp_path / "act")
    spec = PolicySpec(str(policy), "act")

    def screened(spec=spec):
        return run_policy(spec, str(dataset), "fake", tmp_path / "trials", trials=1, slots=1)

    from lerobot_roborecover.curation.policy_trials import read_trials

    first = screened()
    assert [t.row for t in screened()] == [t.row for t in first]
    folder = tmp_path / "trials" / "act"
    config = json.loads((policy / "policy_postprocessor.json").read_text())
    (policy / "policy_postprocessor.json").write_text(json.dumps({**config, "name": "corrected"}))
    second = screened()
    assert len(read_trial_log(folder / "trials.jsonl")) == 4
    assert {t.row.policy for t in first}.isdisjoint(t.row.policy for t in second)
    assert [t.row for t in read_trials(folder)] == [t.row for t in second]
    assert take_trials(folder, tmp_path / "elsewhere") == 2
    (folder / "current.json").unlink()
    with pytest.raises(ScenarioError, match="holds trials of 2 policies"):
        read_trials(folder)
    renamed = PolicySpec(str(policy), "act", rename_map={"a": "b"})
    with pytest.raises(OptionError, match="holds trials with rename_map"):
        screened(renamed)
