"""Automatic annotators: the rules on rollouts made by hand, and the whole way through the page."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.annotation.annotators import EYES, label_kind
from lerobot_roborecover.curation.annotation.looking import LOOK_S, Look, Sheet, frames_to_look_at
from lerobot_roborecover.curation.annotation.rules import Verdict, judge
from lerobot_roborecover.curation.annotation.votes import ballot, read_votes, votes_folder
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.resolution import ResolutionConfig, decisions_of, resolve, scenarios_of
from lerobot_roborecover.scenario import DeviationType, ScenarioError, Stage
from lerobot_roborecover.studio.annotate.serve import AnnotateConfig
from lerobot_roborecover.studio.automatic.run import annotate
from tests.support.browser import chromium, playwright_api
from tests.support.candidate_files import candidate_dataset
from tests.support.processes import PATIENCE_S

FPS, LAST = 80, 200
T = np.arange(LAST + 1)


def ramp(*points: tuple[int, float]) -> np.ndarray:
    """(LAST + 1,) piecewise linear through (frame, value)."""
    return np.interp(T, *zip(*points, strict=True))


def seen(eye: str, closed=None, human: bool = False, solved: bool = False, **objects: dict) -> Look:
    """What an annotator sees of a rollout: `reach`, `goal`, `moved`, `height` of each object."""
    closed = np.ones(LAST + 1) if closed is None else closed
    whole = {
        name: {**{"moved": np.zeros(LAST + 1), "height": np.zeros(LAST + 1)}, **values}
        for name, values in objects.items()
    }
    first = next(iter(whole.values()))
    speed = (np.abs(np.gradient(first["reach"])) + np.abs(np.gradient(first["moved"]))) * FPS
    look = Look(Sheet("it", "do it", LAST, FPS, solved, human))
    for f in frames_to_look_at(EYES[eye].first_look, FPS, LAST):
        look.readings[f] = {
            "hand": {"speed": float(speed[f]), "a3": float(closed[f])},
            **{n: {k: float(v[f]) for k, v in values.items()} for n, values in whole.items()},
        }
    return look


@pytest.mark.parametrize("fps", [10, 20, 80, 400])
@pytest.mark.parametrize("eye", EYES)
def test_looks_follow_the_clock_and_not_the_frames(fps, eye):
    frames = frames_to_look_at(EYES[eye].first_look, fps, 10 * fps)
    (step,) = set(np.diff(frames[:-1]).tolist())
    assert step / fps == pytest.approx(LOOK_S, abs=0.5 / fps + 1e-9)
    assert frames[0] < max(step, 2)
    assert frames[-1] == 10 * fps
    assert frames_to_look_at(EYES[eye].first_look, fps, 0) == [0]
    assert frames_to_look_at(EYES[eye].first_look, 1, 2)[-3:] in ([0, 1, 2], [1, 2])


def test_where_no_goal_is_shown_the_object_is_the_one_that_ends_farthest_from_its_place():
    still = {"reach": ramp((0, 0.3), (50, 0.25))}
    pushed = {"reach": ramp((0, 0.4), (50, 0.02), (100, 0.3)), "moved": ramp((50, 0.0), (60, 0.06))}
    found = judge(seen("auto-1", first=still, second=pushed), EYES["auto-1"])
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


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("case", CASES)
def test_each_deviation_has_its_label_at_its_step(case, eye):
    thing, closed, step, stage, deviation = CASES[case]
    found = judge(seen(eye, closed, thing=thing), EYES[eye])
    assert (found.stage, found.deviation, found.discard) == (stage, deviation, "")
    # Looks are ten frames apart, rest takes 12 frames, and the last 2 or 3 cm are no progress.
    assert step - 10 <= found.step <= step + 22


@pytest.mark.parametrize("eye", EYES)
def test_other_parts_and_what_the_object_is_brought_to(eye):
    still = {"reach": ramp((0, 0.4), (60, 0.3)), "goal": np.full(LAST + 1, 0.3)}
    button = {"reach": ramp((0, 0.4), (60, 0.02)), "moved": ramp((60, 0.0), (66, 0.03))}
    found = judge(seen(eye, cup=still, button=button), EYES[eye])
    assert (found.stage, found.deviation) == (Stage.APPROACH, DeviationType.WRONG_TARGET)
    stick = carried(100, 0.18)
    bottle = {"reach": np.full(LAST + 1, 0.3), "moved": ramp((95, 0.0), (105, 0.07))}
    found = judge(seen(eye, stick=stick, bottle=bottle), EYES[eye])
    assert (found.stage, found.deviation) == (Stage.PLACE, DeviationType.SCENE_CHANGE)


@pytest.mark.parametrize("eye", EYES)
def test_discards(eye):
    def verdict(thing, **sheet) -> str:
        return judge(seen(eye, thing=thing, **sheet), EYES[eye]).discard

    assert verdict(carried(100, 0.0), solved=True) == "temporary"
    fallen = carried(100, 0.18, LOST, height=ramp((120, 0.0), (130, -0.5)))
    assert verdict(fallen) == "irreversible"
    # It is on the move up to the last frame: nothing is final.
    moving = {"reach": ramp((0, 0.4), (LAST, 0.02)), "goal": np.full(LAST + 1, 0.3)}
    assert verdict(moving) == "unclear"
    stopped = {"reach": ramp((0, 0.4), (40, 0.2), (150, 0.2), (LAST, 0.02)), "goal": moving["goal"]}
    assert verdict(stopped) == "temporary"


@pytest.mark.parametrize("eye", EYES)
def test_a_person_marks_by_stopping(eye):
    dropped = {
        "reach": ramp((0, 0.3), (35, 0.02), (70, 0.02), (85, 0.15), (145, 0.15), (160, 0.02)),
        "goal": ramp((40, 0.3), (70, 0.22), (160, 0.22), (195, 0.0)),
        "moved": ramp((40, 0.0), (70, 0.08), (160, 0.08), (195, 0.3)),
    }
    closed = ramp((0, 1.0), (70, 1.0), (71, -1.0), (149, -1.0), (150, 1.0))
    found = judge(seen(eye, closed, human=True, solved=True, thing=dropped), EYES[eye])
    assert (found.stage, found.deviation) == (Stage.APPROACH, DeviationType.STAGE_ROLLBACK)
    assert 85 <= found.step <= 100
    assert judge(seen(eye, human=True, solved=True, thing=carried(100, 0.0)), EYES[eye]) != Verdict(
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
        annotate(AnnotateConfig(tmp_path, ["ann"]), print)


@pytest.mark.browser
@pytest.mark.nightly
def test_three_programs_vote_through_the_page(tmp_path, monkeypatch, capsys):
    chromium()
    playwright_api()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    root = candidate_dataset(tmp_path / "rollouts", 3)
    said: list[str] = []
    config = AnnotateConfig(root, ["auto-1"], port=0, examples=False)
    annotate(config, said.append)
    assert any("3 of 3" in line for line in said)
    assert main(["annotate", str(root), "--automatic"]) == 0
    assert "auto-1: nothing to do" in capsys.readouterr().out
    records = read_votes(votes_folder(root, None))
    assert set(records) == set(EYES)
    candidates = read_candidates(root)
    for name in EYES:
        given = ballot(records[name], 1).votes
        assert set(given) == set(candidates.by_id)
        assert all(0 <= v.seconds < PATIENCE_S for v in given.values())
    found = resolve(candidates, votes_folder(root, None), ResolutionConfig())
    assert found.kind == "automatic"
    assert all(d.by.startswith("automatic votes of auto-1") for d in decisions_of(found, ResolutionConfig()))
    for scenario in scenarios_of(candidates, found, ResolutionConfig()):
        assert scenario.provenance["annotation"]["kind"] == "automatic"
