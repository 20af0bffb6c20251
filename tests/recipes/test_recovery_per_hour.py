"""Recovery per hour: what an arm is trained on, and where corrections begin."""

from __future__ import annotations

import csv
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
from recipes.outcomes import OUTCOMES, method_rates, stored_logs
from recipes.recovery_per_hour import (
    ARMS,
    FIRST_LOOK,
    NONE,
    SUBJECTS,
    Study,
    draw_curve,
    repeated,
    report,
    until,
)
from tests.recipes.test_episodes import some
from tests.support.doc_blocks import section

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


def gain_over_none(table: Path) -> dict[str, tuple[str, float, str]]:
    """By arm, of a report's table: RSR less that of `none` in points, p, and the verdict on the arm."""
    found = {}
    for row in csv.DictReader(table.open(encoding="utf-8")):
        if NONE not in (row["A"], row["B"]):
            continue
        name = "RSR, A − B, runs like these"
        value, low, high = (100 * float(row[column]) for column in (name, f"{name} low", f"{name} high"))
        better, worse = "better", "worse"
        if row["A"] == NONE:
            value, low, high, better, worse = -value, -high, -low, worse, better
        verdict = {"A is better": better, "B is better": worse}.get(row["Verdict on the methods"])
        found[row["B"] if row["A"] == NONE else row["A"]] = (
            f"{value:+.1f} [{low:.1f}, {high:.1f}]", float(row["p (Holm)"]), verdict or "not separated",
        )  # fmt: skip
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("platform", "heading"), [("metaworld", "### Meta-World, "), ("libero", "### LIBERO, ")]
)
def test_the_page_says_what_a_report_on_the_stored_outcomes_does(tmp_path, platform, heading):
    page = (Path(__file__).parents[2] / "docs" / "studies" / "recovery_per_hour.md").read_text("utf-8")
    rows = section(page, heading).splitlines()
    report(stored_logs(OUTCOMES / f"recovery_per_hour_{platform}"), tmp_path)
    everything, primary = (tmp_path / "report" / name for name in ("all", "primary"))
    gains, planned = (gain_over_none(of / "tables" / "method_contrasts.csv") for of in (everything, primary))
    assert set(planned) == set(FIRST_LOOK) - {NONE}
    assert set(gains) == set(ARMS) - {NONE}
    rates = method_rates(everything)
    for arm in ARMS:
        row = next(line for line in rows if line.startswith(f"| `{arm}` | "))
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        recovery, initial = (
            f"{100 * of[arm]['value']:.1f} [{100 * of[arm]['low']:.1f}, {100 * of[arm]['high']:.1f}]"
            for of in rates
        )
        assert (cells[1], cells[3]) == (recovery, initial)
        if arm == NONE:
            continue
        assert cells[4] == gains[arm][0]
        if arm in planned:
            gain, p, verdict = planned[arm]
            assert (cells[4], cells[6]) == (gain, verdict)
            assert float(cells[5]) == pytest.approx(p, rel=0.1)
        else:
            assert cells[5:] == ["", ""]
