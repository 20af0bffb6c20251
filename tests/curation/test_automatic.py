"""Automatic annotators: the rules on rollouts made by hand, and votes on recorded ones."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.annotation import automatic
from lerobot_roborecover.curation.annotation.annotators import LABELERS, label_kind
from lerobot_roborecover.curation.annotation.automatic import annotate, as_printed, reading, sheet_of
from lerobot_roborecover.curation.annotation.discussion import Discussion
from lerobot_roborecover.curation.annotation.features import (
    LOOK_S,
    EpisodeFeatures,
    EpisodeInfo,
    frames_to_look_at,
)
from lerobot_roborecover.curation.annotation.frames import Videos
from lerobot_roborecover.curation.annotation.rules import Verdict, judge
from lerobot_roborecover.curation.annotation.shown import shown
from lerobot_roborecover.curation.annotation.votes import VoteJournal, ballot, read_votes, votes_folder
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.pipeline.work import StageRunners
from lerobot_roborecover.curation.resolution import ResolutionConfig, decisions_of, resolve, scenarios_of
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import DeviationType, ScenarioError, Stage
from tests.support.candidate_files import FPS as RECORDED_FPS
from tests.support.candidate_files import STEPS, candidate_dataset, rollout

FPS, LAST = 80, 200
T = np.arange(LAST + 1)


def ramp(*points: tuple[int, float]) -> np.ndarray:
    """(LAST + 1,) piecewise linear through (frame, value)."""
    return np.interp(T, *zip(*points, strict=True))


def seen(
    eye: str, closed=None, human: bool = False, solved: bool = False, **objects: dict
) -> EpisodeFeatures:
    """What an annotator sees of a rollout: `reach`, `goal`, `moved`, `height` of each object."""
    closed = np.ones(LAST + 1) if closed is None else closed
    whole = {
        name: {**{"moved": np.zeros(LAST + 1), "height": np.zeros(LAST + 1)}, **values}
        for name, values in objects.items()
    }
    first = next(iter(whole.values()))
    speed = (np.abs(np.gradient(first["reach"])) + np.abs(np.gradient(first["moved"]))) * FPS
    look = EpisodeFeatures(EpisodeInfo("it", "do it", LAST, FPS, solved, human))
    for f in frames_to_look_at(LABELERS[eye].first_look, FPS, LAST):
        look.readings[f] = {
            "hand": {"speed": float(speed[f]), "a3": float(closed[f])},
            **{n: {k: float(v[f]) for k, v in values.items()} for n, values in whole.items()},
        }
    return look


@pytest.mark.parametrize("fps", [10, 20, 80, 400])
@pytest.mark.parametrize("eye", LABELERS)
def test_looks_follow_the_clock_and_not_the_frames(fps, eye):
    frames = frames_to_look_at(LABELERS[eye].first_look, fps, 10 * fps)
    (step,) = set(np.diff(frames[:-1]).tolist())
    assert step / fps == pytest.approx(LOOK_S, abs=0.5 / fps + 1e-9)
    assert frames[0] < max(step, 2)
    assert frames[-1] == 10 * fps
    assert frames_to_look_at(LABELERS[eye].first_look, fps, 0) == [0]
    assert frames_to_look_at(LABELERS[eye].first_look, 1, 2)[-3:] in ([0, 1, 2], [1, 2])


def test_where_no_goal_is_shown_the_object_is_the_one_that_ends_farthest_from_its_place():
    still = {"reach": ramp((0, 0.3), (50, 0.25))}
    pushed = {"reach": ramp((0, 0.4), (50, 0.02), (100, 0.3)), "moved": ramp((50, 0.0), (60, 0.06))}
    found = judge(seen("auto-1", first=still, second=pushed), LABELERS["auto-1"])
    assert (found.deviation, found.step is not None and 60 <= found.step <= 90) == (
        DeviationType.SCENE_CHANGE,
        True,
    )


def carried(stop: int, goal_left: float, reach=None, height=None) -> dict:
    """Grasped at frame 60, carried until `stop`; the goal is 30 cm away."""
    way = 0.3 - goal_left
    return {
        "reach": ramp((0, 0.3), (50, 0.02)) if reach is None else reach,
        "goal": ramp((60, 0.3), (stop, goal_left)),
        "moved": ramp((60, 0.0), (stop, way)),
        "height": np.zeros(LAST + 1) if height is None else height,
    }


LOST = ramp((0, 0.3), (50, 0.02), (101, 0.02), (130, 0.25))
CASES = {
    "the hand stays beside the object": (
        {"reach": ramp((0, 0.4), (40, 0.2)), "goal": np.full(LAST + 1, 0.3)},
        None, 40, Stage.APPROACH, DeviationType.WRONG_POSE,
    ),
    "at the object, and never gets hold of it": (
        {"reach": ramp((0, 0.4), (60, 0.04)), "goal": np.full(LAST + 1, 0.3)},
        None, 60, Stage.CONTACT, DeviationType.WRONG_POSE,
    ),
    "stops on the way with it": (carried(100, 0.18), None, 100, Stage.MOVE, DeviationType.WRONG_POSE),
    "stops before the goal": (carried(110, 0.06), None, 110, Stage.PLACE, DeviationType.WRONG_POSE),
    "loses it on the way": (
        carried(100, 0.18, LOST), None, 105, Stage.APPROACH, DeviationType.STAGE_ROLLBACK,
    ),
    "loses it at the goal": (
        carried(100, 0.06, LOST), None, 105, Stage.PLACE, DeviationType.SCENE_CHANGE,
    ),
    "puts it down elsewhere": (
        carried(100, 0.18), ramp((0, 1.0), (110, 1.0), (111, -1.0)),
        111, Stage.PLACE, DeviationType.WRONG_TARGET,
    ),
    "knocks it aside": (
        {
            "reach": ramp((0, 0.3), (40, 0.06), (60, 0.2)), "goal": ramp((40, 0.3), (50, 0.34)),
            "moved": ramp((40, 0.0), (50, 0.07)),
        },
        None, 60, Stage.APPROACH, DeviationType.SCENE_CHANGE,
    ),
}  # fmt: skip


@pytest.mark.parametrize("eye", LABELERS)
@pytest.mark.parametrize("case", CASES)
def test_each_deviation_has_its_label_at_its_step(case, eye):
    thing, closed, step, stage, deviation = CASES[case]
    found = judge(seen(eye, closed, thing=thing), LABELERS[eye])
    assert (found.stage, found.deviation, found.discard) == (stage, deviation, "")
    # Looks are ten frames apart, rest takes 12 frames, and the last 2 or 3 cm are no progress.
    assert step - 10 <= found.step <= step + 22


@pytest.mark.parametrize("eye", LABELERS)
def test_other_parts_and_what_the_object_is_brought_to(eye):
    still = {"reach": ramp((0, 0.4), (60, 0.3)), "goal": np.full(LAST + 1, 0.3)}
    button = {"reach": ramp((0, 0.4), (60, 0.02)), "moved": ramp((60, 0.0), (66, 0.03))}
    found = judge(seen(eye, cup=still, button=button), LABELERS[eye])
    assert (found.stage, found.deviation) == (Stage.APPROACH, DeviationType.WRONG_TARGET)
    stick = carried(100, 0.18)
    bottle = {"reach": np.full(LAST + 1, 0.3), "moved": ramp((95, 0.0), (105, 0.07))}
    found = judge(seen(eye, stick=stick, bottle=bottle), LABELERS[eye])
    assert (found.stage, found.deviation) == (Stage.PLACE, DeviationType.SCENE_CHANGE)


@pytest.mark.parametrize("eye", LABELERS)
def test_discards(eye):
    def verdict(thing, **sheet) -> str:
        return judge(seen(eye, thing=thing, **sheet), LABELERS[eye]).discard

    assert verdict(carried(100, 0.0), solved=True) == "temporary"
    fallen = carried(100, 0.18, LOST, height=ramp((120, 0.0), (130, -0.5)))
    assert verdict(fallen) == "irreversible"
    # It is on the move up to the last frame: nothing is final.
    moving = {"reach": ramp((0, 0.4), (LAST, 0.02)), "goal": np.full(LAST + 1, 0.3)}
    assert verdict(moving) == "unclear"
    stopped = {"reach": ramp((0, 0.4), (40, 0.2), (150, 0.2), (LAST, 0.02)), "goal": moving["goal"]}
    assert verdict(stopped) == "temporary"


@pytest.mark.parametrize("eye", LABELERS)
def test_a_person_marks_by_stopping(eye):
    dropped = {
        "reach": ramp((0, 0.3), (35, 0.02), (70, 0.02), (85, 0.15), (145, 0.15), (160, 0.02)),
        "goal": ramp((40, 0.3), (70, 0.22), (160, 0.22), (195, 0.0)),
        "moved": ramp((40, 0.0), (70, 0.08), (160, 0.08), (195, 0.3)),
    }
    closed = ramp((0, 1.0), (70, 1.0), (71, -1.0), (149, -1.0), (150, 1.0))
    found = judge(seen(eye, closed, human=True, solved=True, thing=dropped), LABELERS[eye])
    assert (found.stage, found.deviation) == (Stage.APPROACH, DeviationType.STAGE_ROLLBACK)
    assert 85 <= found.step <= 100
    assert judge(seen(eye, human=True, solved=True, thing=carried(100, 0.0)), LABELERS[eye]) != Verdict(
        discard="temporary"
    )


def test_names_tell_people_from_programs(tmp_path, capsys):
    assert label_kind(["auto-1", "auto-2"]) == "automatic"
    assert label_kind(["ann", "auto-2"]) == "mixed"
    assert label_kind(["ann"]) == label_kind([]) == "people"
    assert main(["annotate", str(tmp_path), "--annotator", "auto-1"]) == 2
    assert "those of automatic annotators" in capsys.readouterr().err
    assert main(["annotate", str(tmp_path)]) == 2
    assert "--automatic" in capsys.readouterr().err
    with pytest.raises(ScenarioError, match="no automatic annotator 'ann'"):
        annotate(tmp_path, print, annotators=["ann"])


@pytest.mark.parametrize(
    ("value", "digits", "printed"),
    [
        (0.0625, 3, 0.063), (-0.0625, 3, -0.063), (0.1875, 3, 0.188), (0.0005, 3, 0.001), (1.0015, 3, 1.002),
        (2.0, 3, 2.0), (1.005, 2, 1.0), (0.125, 2, 0.13), (44 / 80, 2, 0.55), (-0.0001, 3, 0.0),
    ],
)  # fmt: skip
def test_numbers_are_rounded_as_the_page_prints_them(value, digits, printed):
    """Expected: what `Number((value).toFixed(digits))` is in Chromium."""
    assert as_printed(value, digits) == printed


def test_what_is_read_of_a_frame_is_what_was_recorded(tmp_path):
    candidates = read_candidates(candidate_dataset(tmp_path / "set", 5))
    episode = shown(candidates, 4, RECORDED_FPS)
    sheet = sheet_of("ep-0004", episode, RECORDED_FPS)
    assert (sheet.last, sheet.human, sheet.solved) == (STEPS - 1, True, False)
    # 44 frames at 20 Hz end at 2.20 s.
    assert sheet.fps == pytest.approx(RECORDED_FPS)
    assert sheet_of("x", replace(episode, steps=10), 80).fps == 9 / 0.11
    assert sheet_of("x", replace(episode, steps=1), 80).fps == 1.0
    _, steps = rollout(4)
    eef, puck = steps.bodies["eef"][:, :3], steps.bodies["puck"][:, :3]
    found = reading(episode, 12)
    assert next(iter(found)) == "hand"
    assert set(found["puck"]) - {"speed", "goal"} == {"reach", "moved", "height"}
    speed = np.linalg.norm(eef[13] - eef[12]) * RECORDED_FPS
    assert found["hand"]["speed"] == pytest.approx(speed, abs=6e-4)
    assert found["puck"]["reach"] == pytest.approx(np.linalg.norm(eef[12] - puck[12]), abs=6e-4)
    assert all(round(v, 3) == v for row in found.values() for v in row.values())


def test_three_programs_vote_on_recorded_steps(tmp_path, capsys):
    root = candidate_dataset(tmp_path / "rollouts", 25, dropped=(7,))
    assert main(["annotate", str(root), "--automatic"]) == 0
    said = capsys.readouterr().out.splitlines()
    for name in LABELERS:
        mine = [line.removeprefix(f"{name}: ") for line in said if line.startswith(name)]
        assert [line.split(",")[0] for line in mine[:2]] == ["20 of 24", "24 of 24"]
        assert len(mine) == 3
    assert main(["annotate", str(root), "--automatic"]) == 0
    assert capsys.readouterr().out.splitlines() == [f"{name}: nothing to do" for name in LABELERS]
    folder = votes_folder(root, None)
    records, candidates = read_votes(folder), read_candidates(root)
    assert set(records) == set(LABELERS)
    for name in LABELERS:
        given = ballot(records[name], 1).votes
        assert set(given) == set(candidates.by_id) - {"ep-0007"}
        assert all((v.annotator, v.informed, v.comment) == (name, False, "") for v in given.values())
        assert len(records[name]) == len({r["uid"] for r in records[name]}) == 24
    found = resolve(candidates, folder, ResolutionConfig())
    assert found.kind == "automatic"
    assert all(d.by.startswith("automatic votes of auto-1") for d in decisions_of(found, ResolutionConfig()))
    scenarios = scenarios_of(candidates, found, ResolutionConfig())
    assert scenarios
    assert {s.provenance["annotation"]["kind"] for s in scenarios} == {"automatic"}


def test_a_platform_says_which_command_closes_its_grippers(tmp_path, monkeypatch):
    look = seen("auto-1", closed=np.full(LAST + 1, -1.0), cup={"reach": ramp((0, 0.3))})
    assert not look.closed().any()
    look.sheet = replace(look.sheet, gripper_commands=(1.0, -1.0))
    assert look.closed().all()
    sheets = []
    monkeypatch.setattr(type(platform_named("fake")), "gripper_commands", (0.0, 0.7))
    monkeypatch.setattr(
        automatic, "verdict_on", lambda sheet, *_: sheets.append(sheet) or Verdict(discard="temporary")
    )
    annotate(candidate_dataset(tmp_path / "rollouts", 1), print)
    assert [sheet.gripper_commands for sheet in sheets] == [(0.0, 0.7)] * len(LABELERS)


def test_programs_need_no_video(tmp_path):
    root = candidate_dataset(tmp_path / "rollouts", 2)
    info = json.loads((root / "meta" / "info.json").read_text())
    info["features"] = {k: f for k, f in info["features"].items() if f["dtype"] != "video"}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(ScenarioError, match="has no video"):
        Videos(root)
    annotate(root, print)
    assert all(len(ballot(r, 1).votes) == 2 for r in read_votes(votes_folder(root, None)).values())


def test_a_run_that_was_stopped_goes_on(tmp_path, monkeypatch, capsys):
    root, folder = candidate_dataset(tmp_path / "rollouts", 5), tmp_path / "votes"
    took = automatic.take_vote

    def stopped(book, candidates, candidate, sent):
        if candidate == "ep-0002":
            raise KeyboardInterrupt
        return took(book, candidates, candidate, sent)

    monkeypatch.setattr(automatic, "take_vote", stopped)
    assert main(["annotate", str(root), "--automatic", "--votes", str(folder)]) == 0
    assert "stopped" in capsys.readouterr().out
    monkeypatch.undo()
    first = read_votes(folder)
    assert [r["candidate"] for r in first["auto-1"]] == ["ep-0000", "ep-0001"]
    assert main(["annotate", str(root), "--automatic", "--votes", str(folder)]) == 0
    assert "auto-1: 3 of 3" in capsys.readouterr().out
    then = read_votes(folder)
    assert then["auto-1"][:2] == first["auto-1"]
    assert all([r["candidate"] for r in then[n]] == [f"ep-{i:04d}" for i in range(5)] for n in LABELERS)


def test_a_build_has_them_vote_into_its_own_folder(tmp_path):
    root, said = candidate_dataset(tmp_path / "rollouts", 1), []
    StageRunners().annotate(root, tmp_path / "votes", said.append)
    assert set(read_votes(tmp_path / "votes")) == set(LABELERS)
    assert len(said) == 2 * len(LABELERS)
    assert not votes_folder(root, None).exists()


def test_a_discussion_is_a_round_of_its_own(tmp_path):
    root, listed = candidate_dataset(tmp_path / "rollouts", 3), tmp_path / "discuss.json"
    annotate(root, print)
    Discussion(2, {"ep-0001": {"why": "stage", "votes": []}}).write(listed)
    annotate(root, print, only=listed)
    for records in read_votes(votes_folder(root, None)).values():
        assert [(r["candidate"], r["round"]) for r in records[3:]] == [("ep-0001", 2)]


def test_no_point_is_before_the_first_step_at_which_one_may_be(tmp_path, monkeypatch):
    root = candidate_dataset(tmp_path / "rollouts", 1)
    early = Verdict(0, Stage.MOVE, DeviationType.WRONG_POSE)
    monkeypatch.setattr(automatic, "verdict_on", lambda *_: early)
    annotate(root, print, annotators=["auto-2"])
    (vote,) = read_votes(votes_folder(root, None))["auto-2"]
    # Two actions let the scene settle, and one was executed.
    assert (vote["step"], vote["stage"], vote["deviation"]) == (3, "Move", "Wrong Pose")


def test_what_cannot_be_voted_on_is_refused(tmp_path, monkeypatch):
    root, listed = candidate_dataset(tmp_path / "rollouts", 2, dropped=(1,)), tmp_path / "discuss.json"
    Discussion(2, {"ep-0001": {"why": "stage", "votes": []}}).write(listed)
    with pytest.raises(ScenarioError, match="lists 'ep-0001', which is not in"):
        annotate(root, print, only=listed)
    book = VoteJournal(votes_folder(root, None), "auto-1", 1)
    with pytest.raises(ScenarioError, match="in use by another process"):
        annotate(root, print)
    book.close()
    monkeypatch.setattr(automatic, "verdict_on", lambda *_: Verdict(discard="nothing known"))
    with pytest.raises(ScenarioError, match=r"candidate ep-0000: the vote of auto-1 .*'nothing known'"):
        annotate(root, print)
    empty = candidate_dataset(tmp_path / "none", 1, dropped=(0,))
    with pytest.raises(ScenarioError, match="no candidates left to look at"):
        annotate(empty, print)
