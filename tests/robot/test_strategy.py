"""The strategy for `lerobot-rollout`: LeRobot's own script runs it on the simulated lab."""

from __future__ import annotations

import sys

import pytest

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.robot.recorder import marks
from tests.support.robot_lab import lab_config, scripted

pytestmark = [pytest.mark.lerobot, pytest.mark.slow]


def by_name(config):
    """The class beside a configuration, as LeRobot finds it after 0.6.1."""
    kind = type(config)
    return getattr(sys.modules[kind.__module__], kind.__name__.removesuffix("Config"))(config)


def rollout(tmp_path, monkeypatch, **options):
    """Runs LeRobot's script; the oldest LeRobot has a closed list of strategies, which is opened here."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.rollout.configs import RolloutConfig
    from lerobot.scripts import lerobot_rollout

    from lerobot_roborecover.robot.strategy import RoboRecoverStrategyConfig
    from lerobot_roborecover.utils.plugins import register_plugins

    register_plugins()
    monkeypatch.setattr(lerobot_rollout, "create_strategy", by_name)
    monkeypatch.setattr("sys.argv", ["lerobot-rollout"])
    path = scripted(tmp_path / "policy", size=48)
    policy = PreTrainedConfig.from_pretrained(path)
    policy.pretrained_path = path
    strategy = RoboRecoverStrategyConfig(
        capture_dir=tmp_path / "capture", episodes=2, limit_s=1.0, operator="simulated",
        detector="elapsed,steps=10,threshold=0.75",
    )  # fmt: skip
    config = RolloutConfig(
        robot=lab_config(tmp_path), policy=policy, strategy=strategy, fps=20,
        **{"task": "push the puck", "play_sounds": False, **options},
    )  # fmt: skip
    lerobot_rollout.rollout.__wrapped__(config)


def test_lerobots_own_command_records_episodes_with_marks(tmp_path, monkeypatch):
    from lerobot.datasets import LeRobotDataset

    rollout(tmp_path, monkeypatch)
    found = LeRobotDataset("local/rollout_capture", root=tmp_path / "capture")
    assert (found.num_episodes, len(found)) == (2, 34), "the simulated operator ends both"
    assert found[0]["task"] == "push the puck"
    found = {(mark["episode"], mark["frame"]) for mark in marks(tmp_path / "capture")}
    assert found == {(0, 11), (0, 8), (1, 11), (1, 8)}, "the operator's and the detector's"


@pytest.mark.parametrize(
    ("options", "said"),
    [({"task": ""}, "--task: say what"), ({"interpolation_multiplier": 2}, "multiplier=2: recovery points")],
)
def test_what_it_cannot_record_is_refused(tmp_path, monkeypatch, options, said):
    with pytest.raises(OptionError, match=said):
        rollout(tmp_path, monkeypatch, **options)
