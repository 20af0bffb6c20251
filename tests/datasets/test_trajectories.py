"""Trajectory datasets: what is written is what is read, exactly, and LeRobot trains on it as it is."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.datasets.episodes import to_frame
from lerobot_roborecover.datasets.trajectories import LABEL, read_trajectories
from lerobot_roborecover.datasets.trajectory_write import Trajectory, split_by_scenario, write_trajectories
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.scenario import Pose, Reset, ScenarioError
from tests.support.factories import fake_scenario
from tests.support.processes import PATIENCE_S
from tests.support.training import lerobot_train

pytestmark = pytest.mark.lerobot


def trajectory(index: int, *, steps: int = 5, **changes) -> Trajectory:
    """A fake recovery of scenario `index // 2`, frames from the simulator."""
    scenario = replace(fake_scenario(index // 2), split=("train", "val")[index // 2 % 2])
    actions = np.random.default_rng(100 + index).uniform(-1, 1, (steps, 2))
    simulator = make_simulator("fake", obs_type="pixels_agent_pos", observation_size=64)
    simulator.reset(scenario.task, scenario.reset)
    frames = []
    for action in actions:
        frames.append(to_frame("fake", simulator.observe()))
        simulator.step(action)
    made = Trajectory(
        scenario.task, "expert", actions, frames, True, scenario, first_step=10, trial=index % 2,
        provenance={"seed": index},
    )  # fmt: skip
    return replace(made, **changes)


@pytest.fixture(scope="module")
def donors(tmp_path_factory):
    root = tmp_path_factory.mktemp("out") / "donors"
    return write_trajectories(
        root, "donors", (trajectory(i, steps=4 + i) for i in range(6)), fps=20, license="mit"
    )


def test_rows_links_and_exact_actions_come_back(donors):
    found = read_trajectories(donors)
    made = [trajectory(i, steps=4 + i) for i in range(6)]
    assert (found.kind, found.platform, found.manifest["license"]) == ("donors", "fake", "mit")
    assert [s.id for s in found.scenarios] == [fake_scenario(i).id for i in range(3)]
    assert [r.scenario_index for r in found.rows] == [0, 0, 1, 1, 2, 2]
    assert [(r.steps, r.trial, r.driver, r.first_step) for r in found.rows] == [
        (4 + i, i % 2, "expert", 10) for i in range(6)
    ]
    for actions, t in zip(found.actions(), made, strict=True):
        assert actions.tobytes() == t.actions.tobytes()
    assert found.manifest["counts"]["frames"] == sum(range(4, 10))


def test_a_rollout_carries_its_reset_or_says_why_it_cannot_be_replayed(tmp_path):
    scenario = fake_scenario(0)
    pose = Pose((0.1, 0.2, 0.3), (0.0, 0.0, 0.6, 0.8))
    reset = Reset(seed=5, init_state_index=3, settle_steps=2, fixtures={"stove": pose})
    made = [
        trajectory(0, scenario=None, reset=reset),
        trajectory(1, scenario=None, not_replayable="unknown init state", success=False),
    ]
    rows = read_trajectories(write_trajectories(tmp_path / "set", "rollouts", made, fps=20)).rows
    assert [r.reset_record() for r in rows] == [reset, None]
    assert [r.task_record() for r in rows] == [scenario.task] * 2
    assert [r.scenario_index for r in rows] == [-1, -1]
    assert rows[1].not_replayable == "unknown init state"


def test_splits_go_by_scenario(donors):
    found = read_trajectories(donors)
    assert found.episodes("train") == [0, 1, 4, 5]
    assert found.episodes("val") == [2, 3]
    with pytest.raises(ScenarioError, match=r"'test'.*'train', 'val'"):
        found.episodes("test")


def test_policies_see_lerobot_s_features_and_nothing_of_ours(donors):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.utils.feature_utils import dataset_to_policy_features

    dataset = LeRobotDataset("lab/donors", root=donors)
    assert dataset.num_episodes == 6
    assert set(dataset_to_policy_features(dataset.features)) == {
        "observation.image", "observation.state", "observation.environment_state", "action",
    }  # fmt: skip
    assert dataset[0]["task"] == "push the puck to the goal"


def test_monitor_frames_carry_their_label_where_a_reward_model_looks(monitor):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    found = read_trajectories(monitor)
    assert found.manifest["counts"]["labels"] == {
        "train:0": 4, "train:1": 6, "validation:0": 4, "validation:1": 6,
    }  # fmt: skip
    dataset = LeRobotDataset("lab/monitor", root=monitor)
    assert [float(dataset[i][LABEL]) for i in range(10)] == [0, 0, 1, 1, 1] * 2
    assert found.episodes("validation") == [2, 3]


@pytest.fixture(scope="module")
def monitor(tmp_path_factory):
    made = [trajectory(i, labels=[0, 0, 1, 1, 1]) for i in range(4)]
    splits = {made[0].scenario.id: "train", made[2].scenario.id: "validation"}
    return write_trajectories(
        tmp_path_factory.mktemp("out") / "monitor", "monitor", made, fps=20, splits=splits
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["donors", pytest.param("monitor", marks=pytest.mark.nightly)])
def test_lerobot_train_takes_both_as_they_are(request, kind, tmp_path):
    root = request.getfixturevalue(kind)
    episodes = read_trajectories(root).episodes("train")
    options = """
        --dataset.repo_id=lab/any --policy.type=act --policy.device=cpu --policy.push_to_hub=false
        --steps=2 --batch_size=2 --num_workers=0 --wandb.enable=false --log_freq=1 --policy.chunk_size=4
        --policy.n_action_steps=2 --policy.dim_model=16 --policy.n_heads=2 --policy.dim_feedforward=16
        --policy.pretrained_backbone_weights=null
    """
    folders = [f"--dataset.root={root}", f"--output_dir={tmp_path / 'out'}"]
    lerobot_train(*folders, f"--dataset.episodes={episodes}", *options.split())
    assert list((tmp_path / "out" / "checkpoints").glob("*/pretrained_model/model.safetensors"))


@pytest.mark.nightly
@pytest.mark.slow
def test_lerobot_s_viewer_shows_scenario_and_trajectory_datasets(donors, tmp_path):
    import subprocess
    import sys
    from pathlib import Path

    pytest.importorskip("rerun", reason="no rerun: pip install 'lerobot_env_roborecover[viz]'")
    from lerobot_roborecover.datasets.write import write_episodes

    def camera():
        return make_simulator("fake", obs_type="pixels_agent_pos", observation_size=64)

    scenarios = write_episodes(tmp_path / "set", [fake_scenario(i, steps=5) for i in range(2)], camera)
    program = str(Path(sys.executable).with_name("lerobot-dataset-viz"))
    for root in (donors, scenarios):
        command = [program, "--repo-id=lab/x", f"--root={root}", "--episode-index=1", "--save=1"]
        command += [f"--output-dir={tmp_path / 'viz'}", "--num-workers=0"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
        assert done.returncode == 0, done.stderr[-3000:]
        (recording,) = (tmp_path / "viz").glob("*.rrd")
        assert recording.stat().st_size > 1000
        recording.unlink()


@pytest.mark.parametrize(
    ("kind", "changes", "words"),
    [
        ("donors", {"success": False}, ["donor recovers the task"]),
        ("donors", {"scenario": None}, ["belong to a scenario"]),
        ("donors", {"labels": [0, 0, 1, 1, 1]}, ["have no labels"]),
        ("monitor", {}, ["need labels"]),
        ("monitor", {"labels": [0, 1]}, ["5 values"]),
        ("monitor", {"labels": [0, 1, 0, 1, 1]}, ["back from 1 to 0"]),
        ("rollouts", {"actions": np.full((5, 2), np.nan)}, ["finite"]),
        ("rollouts", {"actions": np.zeros((5, 3))}, ["(5, 3)"]),
        ("rollouts", {"actions": np.zeros((5, 2), np.float32)}, ["float32"]),
        ("rollouts", {"scenario": None}, ["its reset, or says why"]),
        ("rollouts", {"frames": []}, ["5 actions, but 0 frames"]),
        ("friends", {}, ["'friends'", "donors, monitor, rollouts"]),
    ],
)
def test_what_does_not_fit_is_refused_and_leaves_nothing(tmp_path, kind, changes, words):
    with pytest.raises(ScenarioError) as caught:
        write_trajectories(tmp_path / "set", kind, [trajectory(0, **changes)], fps=20)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.update(schema_version=99), ["schema_version", "future"]),
        (lambda m: m["trajectories"][0].update(scenario_index=9), ["scenario_index"]),
        (lambda m: m["trajectories"].pop(), ["counts"]),
        (lambda m: m["trajectories"][0]["task"].update(name="../x"), ["'../x'"]),
        (lambda m: m["trajectories"][2].update(steps="9"), ["trajectory 2", "steps", "'9'"]),
        (lambda m: m["trajectories"][1].update(success="no"), ["trajectory 1", "success"]),
        (lambda m: m["trajectories"][1].update(reset={"seed": -1, "fixtures": {}}), ["seed", "-1"]),
        (lambda m: m["trajectories"][1].update(reset=[]), ["not what write_trajectories writes"]),
        (lambda m: m.update(kind="x"), ["kind"]),
        (lambda m: m["scenarios"][0].update(extra=1), ["extra"]),
        (lambda m: m["scenarios"][1].update(sha256=m["scenarios"][0]["sha256"]), ["two splits"]),
    ],
)
def test_metadata_that_lies_is_refused(donors, tmp_path, change, words):
    path = tmp_path / "meta/roborecover/trajectories.json"
    path.parent.mkdir(parents=True)
    manifest = json.loads((donors / "meta/roborecover/trajectories.json").read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))
    with pytest.raises(ScenarioError) as caught:
        read_trajectories(tmp_path)
    assert all(word in str(caught.value) for word in ["trajectories.json", *words]), str(caught.value)


def test_a_split_by_scenario_is_exact_repeatable_and_a_function_of_the_id():
    ids = [f"s{i}" for i in range(10)] * 4
    first = split_by_scenario(ids, {"train": 8, "val": 2}, np.random.default_rng(3))
    assert sorted(first.values()) == ["train"] * 8 + ["val"] * 2
    assert first == split_by_scenario(reversed(ids), {"train": 8, "val": 2}, np.random.default_rng(3))
    assert first != split_by_scenario(ids, {"train": 8, "val": 2}, np.random.default_rng(4))
    with pytest.raises(ScenarioError, match="need 9 scenarios; there are 10"):
        split_by_scenario(ids, {"train": 8, "val": 1}, np.random.default_rng(3))
