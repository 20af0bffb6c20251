"""Recovery per hour: what an arm is trained on, and where corrections begin."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import yaml

from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.scenario import Start
from recipes.corrections import forks
from recipes.episodes import ACTION, REWARD, frames_of
from recipes.learned import LearnedPolicy
from recipes.recovery_per_hour import ARMS, SUBJECTS, Study, draw_curve, repeated, until
from tests.recipes.test_episodes import some

SUBJECT = SUBJECTS["metaworld"]


def test_demonstrations_and_corrections_are_as_many_frames_each():
    for lengths, frames in (([3, 5], 21), ([30], 7), ([4], 4), ([4], 0)):
        made = list(repeated(some(lengths, 1.0), frames))
        assert frames_of(made) == frames
        assert [len(e) for e in made[:-1]] == [lengths[i % len(lengths)] for i in range(len(made) - 1)]
    assert SUBJECT.frames(5) == 5 * 60 * 80
    assert len(ARMS) == 10


def test_a_source_stops_when_there_is_enough():
    assert [len(e) for e in until(some([3, 5, 4, 9], 1.0), 8)] == [3, 5]
    assert [len(e) for e in until(some([3, 5], 1.0), 80)] == [3, 5]


@pytest.mark.parametrize("platform", SUBJECTS)
def test_what_a_study_needs_is_in_the_clone(platform):
    subject = SUBJECTS[platform]
    assert subject.platform == platform
    for folder in subject.base, *map(subject.base.with_name, subject.donors):
        assert (folder / "model.safetensors").is_file()
    config = yaml.safe_load(Path(f"policies/train/recovery_per_hour_{platform}.yaml").read_text())
    assert config["policy"]["path"] == str(subject.base)


def test_tests_are_natural_failures(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr("recipes.recovery_per_hour.evaluate", lambda *words, **_: asked.append(words))
    study = Study(SUBJECT, tmp_path)
    study.trials(SUBJECT.base, "test", tmp_path)
    study.trials(SUBJECT.base, "train", tmp_path)
    assert ["--env.select=source=natural" in words for words in asked] == [True, False]


def test_the_curve_has_a_line_for_each_source(tmp_path):
    value = lambda rate: {"value": rate, "low": rate - 0.05, "high": rate + 0.05}  # noqa: E731
    rows = [[arm, value(0.4 + 0.01 * i)] for i, arm in enumerate(ARMS) if arm != "donors_45"]
    tables = {
        name: {"columns": [{"title": "Policy"}, {"title": title}], "rows": rows}
        for name, title in (("methods", "RSR %, runs like these"), ("overall", "Initial state %"))
    }
    (tmp_path / "results.json").write_text(json.dumps({"tables": tables}))
    drawn = draw_curve(tmp_path).read_text()
    for source in ("donors", "takeover", "forks"):
        assert f"<!-- {source}, recovery points -->" in drawn
        assert f"<!-- {source}, initial states -->" in drawn


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.parametrize(
    ("platform", "base", "task"),
    [
        ("metaworld", SUBJECT.base, "push-v3"),
        pytest.param("libero", Path("policies/libero/act_few"), "put_the_bowl_on_the_plate",
                     marks=pytest.mark.libero),
    ],
)  # fmt: skip
def test_an_operator_goes_on_from_where_the_policy_is(platform, base, task):
    """From a recovery point, and ten steps on: each correction ends with a solved task."""
    recipes = import_module(f"recipes.{platform}.corrections")
    scenarios = load_scenarios(f"{platform}_recovery", split="train")
    scenario = next(s for s in scenarios if s.task.name == task)
    simulator = make_simulator(platform, obs_type="state")
    failures = [(scenario, Start.RECOVERY)]
    found = list(forks(simulator, recipes.correction, base, failures, stride=10, last=10))
    # The policy goes on where it was before the operator was tried, to the last bit.
    drive = LearnedPolicy(simulator, scenario.task, str(base))
    hand_off(simulator, scenario)
    wanted = [simulator.state_sha256()]
    for t in range(10):
        simulator.step(drive(t))
    wanted.append(simulator.state_sha256())
    tried = []
    none = lambda simulator, _task, _seed: tried.append(simulator.state_sha256())  # noqa: E731
    assert list(forks(simulator, none, base, failures, stride=10, last=10)) == []
    assert tried == wanted

    def spoil(simulator, _task, _seed):
        tried.append(simulator.state_sha256())
        for _ in range(5):
            simulator.step(np.ones(simulator.action_dim))

    assert list(forks(simulator, spoil, base, failures, stride=10, last=10)) == []
    assert tried[2:] == wanted
    simulator.close()
    found += recipes.takeovers(base, [scenario.task], 20)
    assert len(found) > 1
    for episode in found:
        assert episode.columns[REWARD][-1] == 1.0
        assert episode.columns[REWARD][0] == 0.0
        assert np.abs(episode.columns[ACTION]).max() <= 1.0
