"""Raters mark a robot's recovery points on the annotation page; their majority becomes the points."""

from __future__ import annotations

import uuid

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.annotation.shown import shown, take_vote
from lerobot_roborecover.curation.annotation.votes import VoteJournal, votes_folder
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.robot import make_points
from lerobot_roborecover.robot.points import read_points
from tests.support.robot_lab import lab, scripted

pytestmark = pytest.mark.lerobot


def vote(step: int, verdict: str = "recovery", **values) -> dict:
    found = {"uid": uuid.uuid4().hex, "candidate": "", "verdict": verdict, "comment": "", "seconds": 3.0}
    labels = {"step": step, "stage": "Contact", "deviation": "Wrong Pose", "reason": ""}
    return {
        **found,
        **(labels if verdict == "recovery" else {"step": None, "stage": "", "deviation": ""}),
        **values,
    }


@pytest.mark.nightly
def test_votes_of_several_raters_become_points(tmp_path, capsys):
    from lerobot_roborecover.robot.annotate import write_episodes
    from lerobot_roborecover.robot.capture import capture
    from lerobot_roborecover.robot.console import Console
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator
    from lerobot_roborecover.robot.policies import load_context
    from lerobot_roborecover.robot.suggestions import FailureWatch

    lines = []
    with lab(tmp_path) as robot:
        context = load_context(
            robot, scripted(tmp_path / "p", size=48), fps=20, instruction=robot.instruction
        )
        watch = FailureWatch("elapsed,steps=4,threshold=0.9", context.data.dataset_features)
        capture(
            robot, context, tmp_path / "cube", Console(SimulatedOperator(robot)), episodes=2, limit_s=5.0,
            instruction=robot.instruction, watch=watch, say=lines.append,
        )  # fmt: skip
    folder = tmp_path / "points.candidates"
    write_episodes(tmp_path / "cube", folder)
    candidates = read_candidates(folder)
    suggested = [[(s.step, s.by) for s in c.suggestions] for c in candidates.candidates]
    assert suggested == [[(11, "operator"), (4, "detector")]] * 2
    assert "1 mark at [11], the detector's alarm at 4" in lines[0]
    assert shown(candidates, 0, 20.0).actions
    first, second = (c.id for c in candidates.candidates)
    for name, step in (("kim", 9), ("lee", 11)):
        book = VoteJournal(votes_folder(folder, None), name, 1)
        take_vote(book, candidates, first, vote(step))
        take_vote(book, candidates, second, vote(0, "discard", reason="not_still"))
        book.close()
    words = [
        "robot",
        "points",
        str(tmp_path / "cube"),
        "--out",
        str(tmp_path / "points"),
        "--time-limit",
        "6",
    ]
    assert main([*words, "--votes-needed", "2"]) == 0
    (point,) = read_points(tmp_path / "points").points
    assert (point.frame, point.scenario.cell, point.quasi_static) == (9, "Contact-Wrong Pose", True)
    votes = point.scenario.provenance["annotation"]["votes"]
    assert [v["annotator"] for v in votes] == ["kim", "lee"]
    assert "1 dropped, 1 kept" in capsys.readouterr().out
    # A detector only suggests; with --at a person takes a suggestion up.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(make_points, "marks", lambda root: [{"episode": 0, "frame": 4, "by": "detector"}])
        assert main([*words, "--quasi-static"]) == 2
    assert "has no marks of a person" in (line := capsys.readouterr().err)
    assert "(a detector suggests 0:4)" in line
    # One person who has looked names a moment; who has not is asked to.
    assert main([*words, "--at", "0:10"]) == 2
    assert "--quasi-static: look at each moment first" in capsys.readouterr().err
    assert main([*words, "--at", "0:10:Place:Scene Change", "--quasi-static"]) == 0
    assert read_points(tmp_path / "points").points[0].scenario.cell == "Place-Scene Change"
    assert main([*words, "--at", "0:999", "--quasi-static"]) == 2
    assert "frame 999 is not from 1 to" in capsys.readouterr().err


@pytest.mark.nightly
def test_a_second_rater_scores_the_recordings_blind(tmp_path):
    import threading

    from lerobot_roborecover.robot.console import Console
    from lerobot_roborecover.robot.rate import rate_all
    from lerobot_roborecover.scenario import ScenarioError
    from tests.logs.test_robot_rows import TRIAL, robot_row
    from tests.robot.test_rollout import roll
    from tests.support.trial_rows import write_log

    folder = tmp_path / "run"
    with lab(tmp_path) as robot:
        policy = scripted(tmp_path / "p", size=48)
        for seed in range(2):
            robot.new_scene(seed)
            roll(robot, policy, folder / "rollout_run", limit_s=0.5)
    from dataclasses import replace

    rows = [
        robot_row(i, 0, i == 0, replace(TRIAL, episode=i, verdict="success" if i == 0 else "failure"))
        for i in range(2)
    ]
    write_log(folder / "trials.jsonl", rows)
    with pytest.raises(ScenarioError, match="gave this run's first verdicts"):
        rate_all(folder, "kim", 0, Console(), print)
    console = Console()
    shown_to_rater, undone = [], []

    def press():
        while console.state()["name"] != "over":
            state = console.state()
            if state["name"] == "rate":
                shown_to_rater.append(state)
                undo = "undo" in state["buttons"] and not undone
                if console.press("undo" if undo else "success") and undo:
                    undone.append(state["text"])

    thread = threading.Thread(target=press)
    thread.start()
    assert rate_all(folder, "lee", 0, console, lambda line: None) == 2
    thread.join(10)
    assert undone == ["1 of 2 rated. The one before: success. Is the task done at the end?"]
    assert all("code" not in state["details"] for state in shown_to_rater)
    from lerobot_roborecover.analysis.second_rater import agreement_of, cohens_kappa
    from lerobot_roborecover.robot.rate import agreement_text

    count, share, kappa = agreement_of(folder)["lee"]
    assert (count, share, kappa) == (2, 0.5, 0.0)
    assert agreement_text(folder) == "lee: 2 trials, 50 % alike, kappa 0.00"
    import numpy as np

    one = np.array([1, 1, 0, 0, 1, 0, 1, 1], bool)
    other = np.array([1, 0, 0, 0, 1, 0, 1, 1], bool)
    # By hand: 7 of 8 alike; chance 5/8 * 4/8 + 3/8 * 4/8 = 1/2.
    assert cohens_kappa(one, other) == pytest.approx(0.75)
    assert np.isnan(cohens_kappa(np.ones(3, bool), np.ones(3, bool)))
