"""A policy on the simulated lab: recorded, watched, ended in time; and whatever breaks leaves its episode."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.robot.console import Answer, Console
from lerobot_roborecover.robot.recorder import Recorder, marks, read_notes, truths
from tests.support.robot_lab import lab, scripted

pytestmark = pytest.mark.lerobot


class Presses:
    """Presses buttons at given polls."""

    def __init__(self, **at):
        self.at, self.count = {v: k for k, v in at.items()}, -1

    def answer(self, screen, details):
        self.count += 1
        return Answer(self.at[self.count]) if self.count in self.at else None


class Still:
    """A teleoperator that holds its robot where it is told to."""

    def get_action(self):
        return {"x.pos": 123.0, "y.pos": -50.0}


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return scripted(tmp_path_factory.mktemp("policies") / "good", size=48)


def roll(robot, policy, folder, presses=None, limit_s=3.0, teleop=None, detector=""):
    from lerobot_roborecover.robot.policies import load_context
    from lerobot_roborecover.robot.rollout import RecordedRollout
    from lerobot_roborecover.robot.suggestions import FailureWatch

    context = load_context(robot, policy, fps=20, instruction=robot.instruction)
    recorder = Recorder(folder, "rollout_test", robot, context.data.dataset_features, 20)
    watch = FailureWatch(detector, context.data.dataset_features) if detector else None
    strategy = RecordedRollout(recorder, Console(presses), limit_s, robot.instruction, teleop, watch=watch)
    strategy.setup(context)
    strategy.run(context)
    strategy.teardown(context)
    return strategy.end


def test_episodes_are_whole_after_each_rollout_and_the_robot_stays_connected(tmp_path, policy):
    from lerobot.datasets import LeRobotDataset

    with lab(tmp_path) as robot:
        first = roll(
            robot, policy, tmp_path / "d", Presses(mark=10, takeover=20, handback=30, end=40), 9.0, Still()
        )
        assert (first.steps, first.ended, first.button, first.episode) == (40, "button", "end", 0)
        assert first.marks == [10]
        assert first.interventions == [{"kind": "takeover", "step": 20, "by": "person", "steps": 10}]
        assert len(LeRobotDataset("local/rollout_test", root=tmp_path / "d")) == 40
        second = roll(robot, policy, tmp_path / "d", limit_s=1.0, detector="elapsed,steps=10,threshold=0.75")
        assert (second.steps, second.ended, second.episode) == (20, "time", 1)
        assert (second.marks, second.suggested) == ([], 8)
        still = "no_progress,steps=5,scale=1000,threshold=0.5"
        third = roll(robot, policy, tmp_path / "still", limit_s=0.5, detector=still)
        assert third.suggested == 5
        assert robot.is_connected
    found = LeRobotDataset("local/rollout_test", root=tmp_path / "d")
    assert (found.num_episodes, len(found)) == (2, 60)
    taken = [bool(found[i]["intervention"]) for i in range(40)]
    assert taken == [20 <= i < 30 for i in range(40)]
    np.testing.assert_allclose(found[25]["action"], [123.0, -50.0])
    assert read_notes(tmp_path / "d").robot_type == "roborecover_lab"
    assert marks(tmp_path / "d") == [
        {"episode": 0, "frame": 10, "by": "operator"},
        {"episode": 1, "frame": 8, "by": "detector"},
    ]
    assert len(truths(tmp_path / "d", 1)) == 20


@pytest.mark.slow
@pytest.mark.nightly
def test_the_scripted_policy_solves_the_task_and_a_biased_one_is_worse(tmp_path, policy):
    worse = scripted(tmp_path / "policy", size=48, bias_mm=60.0)
    solved = {"good": 0, "worse": 0}
    with lab(tmp_path) as robot:
        for seed in range(3):
            for name, path in (("good", policy), ("worse", worse)):
                robot.new_scene(seed)
                roll(robot, path, tmp_path / name, limit_s=6.0)
                solved[name] += robot.world.succeeded()
    assert solved["good"] >= 2
    assert solved["good"] > solved["worse"]


def test_trouble_ends_a_rollout_in_one_line_and_keeps_what_was_recorded(tmp_path, policy):
    with lab(tmp_path, unplug_at_step=15) as robot:
        lost = roll(robot, policy, tmp_path / "lost")
    assert (lost.ended, lost.steps, lost.episode) == ("trouble", 15, 0)
    assert "does not answer" in lost.problem
    assert "\n" not in lost.problem
    assert json.loads((tmp_path / "lost/meta/info.json").read_text())["total_frames"] == 15
    with lab(tmp_path, freeze_at_step=5) as robot:
        frozen = roll(robot, policy, tmp_path / "frozen")
    assert frozen.ended == "trouble"
    assert "camera 'top' has given the same picture for 1.0 s" in frozen.problem
    assert 24 <= frozen.steps <= 27


def test_a_policy_that_raises_is_not_taken_for_a_lost_robot(tmp_path, policy, monkeypatch):
    from lerobot_roborecover.robot.lab.modeling_lab_pusher import LabPusherPolicy
    from lerobot_roborecover.robot.policies import load_context, warm_up

    def fails(self, batch):
        raise RuntimeError("shapes do not match")

    with lab(tmp_path) as robot:
        context = load_context(robot, policy, fps=20, instruction="push")
        warm_up(context)
        monkeypatch.setattr(LabPusherPolicy, "select_action", fails)
        with pytest.raises(
            OptionError, match="cannot infer on what the robot observes: RuntimeError: shapes"
        ):
            warm_up(context)
        end = roll(robot, policy, tmp_path / "raised")
        monkeypatch.undo()
        assert roll(robot, policy, tmp_path / "raised", limit_s=0.5).episode == 0
    assert (end.ended, end.steps, end.episode) == ("policy", 0, None)
    assert end.problem == "the policy failed: RuntimeError: shapes do not match"


def test_a_policy_whose_camera_is_not_there_is_refused_before_anything_moves(tmp_path, policy):
    from lerobot_roborecover.robot.policies import load_context

    with lab(tmp_path) as robot:
        robot.observation_features = {n: f for n, f in robot.observation_features.items() if n != "top"}
        with pytest.raises(
            OptionError, match=r"needs observation.images.top; the robot has observation.images.wrist"
        ):
            load_context(robot, policy, fps=20, instruction="push")
        with pytest.raises(OptionError, match="cannot be loaded"):
            load_context(robot, str(tmp_path / "nothing"), fps=20, instruction="push")


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("elapsed", "has no threshold, and would never trigger"),
        ("oracle", "needs to know the outcome, which no robot knows"),
        ("state_distance,threshold=1", "has not been fitted"),
        ("chunk_disagreement,threshold=1", "looks into the policy that acts"),
        ("no_progress,keys=observation.environment_state,threshold=1", "the robot gives action, observation"),
    ],
)
def test_a_detector_that_cannot_help_on_a_robot_is_one_line(what, words):
    from lerobot_roborecover.robot.suggestions import FailureWatch

    with pytest.raises(OptionError, match=words) as err:
        FailureWatch(what, {"observation.state": {}, "action": {}})
    assert str(err.value).startswith(f"--detector={what}: ")


@pytest.mark.slow
@pytest.mark.nightly
def test_real_time_chunking_on_the_lab(tmp_path, monkeypatch):
    """SmolVLA, small and random, infers in LeRobot's own thread while the robot moves."""
    from huggingface_hub import constants
    from lerobot.datasets import LeRobotDataset
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
    from lerobot.rollout.inference import RTCInferenceConfig

    from lerobot_roborecover.robot.policies import load_context, warm_up
    from lerobot_roborecover.robot.rollout import RecordedRollout
    from tests.support.small_families import save_family
    from tests.support.small_hub import make_hub

    cache = make_hub(tmp_path / "hub")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
    images = ("observation.images.top", "observation.images.wrist")
    vla = str(save_family(tmp_path / "vla", "smolvla", cache, state=2, action=2, images=images))
    rtc = RTCInferenceConfig(queue_threshold=3)
    rtc.rtc.execution_horizon = 3
    with lab(tmp_path) as robot, pytest.raises(OptionError, match="takes the wall's time"):
        load_context(robot, vla, fps=20, instruction="push", inference=rtc)
    with lab(tmp_path, realtime=True) as robot:
        context = load_context(robot, vla, fps=10, instruction="push the puck", inference=rtc)
        warm_up(context)
        recorder = Recorder(tmp_path / "d", "rollout_rtc", robot, context.data.dataset_features, 10)
        buttons = Presses(takeover=8, handback=14)
        rollout = RecordedRollout(recorder, Console(buttons), 3.0, "push the puck", Still())

        def roll():
            rollout.setup(context)
            rollout.run(context)
            rollout.teardown(context)
            return rollout.end

        end = roll()
        assert (end.ended, end.episode) == ("time", 0)
        assert 10 <= end.steps <= 30
        assert end.interventions[0]["steps"] == 6
        data = LeRobotDataset("local/rollout_rtc", root=tmp_path / "d")
        actions = data.hf_dataset.with_format("numpy")["action"]
        assert len(actions) == end.steps
        assert len({tuple(a) for a in np.asarray(actions).tolist()}) > 5
        assert roll().episode == 1, "the engine is used again"

        def fails(self, *args, **kwargs):
            raise RuntimeError("shapes do not match")

        monkeypatch.setattr(SmolVLAPolicy, "predict_action_chunk", fails)
        monkeypatch.setattr("lerobot.rollout.inference.rtc._RTC_ERROR_RETRY_DELAY_S", 0.01)
        end = roll()
        assert (end.ended, end.steps) == ("policy", 0)
        assert "the policy failed in its own thread (RTC)" in end.problem
        again = load_context(robot, vla, fps=10, instruction="push the puck", inference=rtc)
        with pytest.raises(OptionError, match="gave no action within"):
            warm_up(again)
