"""Recordings of LeRobot become rollouts."""

from __future__ import annotations

import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest

from lerobot_roborecover.datasets.trajectories import read_exact, read_trajectories
from lerobot_roborecover.platforms import platform_named
from tests.support.conversion_scripts import script
from tests.support.lerobot_folders import STEPS, lerobot_folder, write_tasks

pytestmark = pytest.mark.lerobot


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A dataset as `lerobot-eval --eval.recording=true` leaves it, on Meta-World."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path_factory.mktemp("recorded") / "recording"
    features = {
        "observation.image": {
            "dtype": "video",
            "shape": (32, 32, 3),
            "names": ["height", "width", "channel"],
        },
        "observation.state": {"dtype": "float32", "shape": (4,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    }
    dataset = LeRobotDataset.create("lab/recording", fps=80, features=features, root=root, use_videos=True)
    rng = np.random.default_rng(2)
    for episode in range(3):
        for step in range(4 + episode):
            dataset.add_frame(
                {
                    "observation.image": rng.integers(0, 256, (32, 32, 3), dtype=np.uint8),
                    "observation.state": rng.uniform(-1, 1, 4).astype(np.float32),
                    "action": rng.uniform(-1, 1, 4).astype(np.float32),
                    "next.reward": np.zeros(1, np.float32),
                    "next.success": np.array([episode == 1 and step == 4]),
                    "next.done": np.zeros(1, bool),
                    "task": platform_named("metaworld").task("button-press-v3").instruction,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root


def test_a_recording_of_lerobot_eval_becomes_rollouts(recorded, tmp_path, capsys):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    arguments = [str(recorded), "--platform", "metaworld", "--driver", "act", "--out", str(tmp_path / "out")]
    assert script("lerobot_rollouts").main([*arguments, "--task", "button-press-v3"]) == 0
    assert "3 trajectories, 1 successful, 0 replayable exactly; 0 refused" in capsys.readouterr().out
    found = read_trajectories(tmp_path / "out")
    assert [r.success for r in found.rows] == [False, True, False]
    assert [r.steps for r in found.rows] == [4, 5, 6]
    assert {r.not_replayable for r in found.rows} == {
        "the recording does not name its reset (seed or init state)"
    }
    before = LeRobotDataset("lab/a", root=recorded)
    after = LeRobotDataset("lab/b", root=tmp_path / "out")
    assert len(after) == len(before)
    exact = np.concatenate([actions for actions, _ in read_exact(tmp_path / "out")])
    for i in (0, 7, 14):
        np.testing.assert_array_equal(exact[i], before[i]["action"].numpy().astype(np.float64))
        np.testing.assert_array_equal(after[i]["observation.image"], before[i]["observation.image"])


def test_a_dataset_without_no_ops_and_with_another_width_is_told_apart(recorded, tmp_path, capsys):
    copy = tmp_path / "some_no_noops"
    shutil.copytree(recorded, copy)
    convert = script("lerobot_rollouts").main
    common = ["--driver", "act", "--out", str(tmp_path / "out")]
    assert convert([str(copy), "--platform", "libero", *common]) == 2
    assert "width 4; libero takes 7" in capsys.readouterr().err
    assert convert([str(copy), "--platform", "metaworld", "--task", "button-press-v3", *common]) == 0
    assert all("no-ops were taken out" in r.not_replayable for r in read_trajectories(tmp_path / "out").rows)
    assert (
        convert([str(tmp_path), "--platform", "metaworld", *common[:2], "--out", str(tmp_path / "o2")]) == 2
    )
    assert "meta/info.json" in capsys.readouterr().err


def convert_rollouts(root, out):
    return script("lerobot_rollouts").main(
        [str(root), "--platform", "metaworld", "--driver", "act", "--out", str(out)]
    )


def test_rollouts_are_of_the_task_of_their_index_wherever_its_row_is(tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = ["button-press-v3", "door-open-v3", "drawer-close-v3"]
    tasks = [platform_named("metaworld").task(name).instruction for name in names]
    root = lerobot_folder(tmp_path / "recording", tasks)
    write_tasks(root, [tasks[i] for i in (2, 0, 1)], [2, 0, 1])
    assert convert_rollouts(root, tmp_path / "out") == 0
    assert [r.task["name"] for r in read_trajectories(tmp_path / "out").rows] == names
    dataset = LeRobotDataset("lab/x", root=tmp_path / "out")
    assert [dataset[i * STEPS]["task"] for i in range(3)] == tasks, "LeRobot counts the rows"


@pytest.mark.parametrize("column", ["named so", "in the data alone"])
def test_a_column_actions_is_refused_in_one_line(tmp_path, capsys, column):
    root = lerobot_folder(tmp_path / "recording", ["open it"])
    info, data = root / "meta" / "info.json", root / "data" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(data)
    names = ["actions" if n == "action" else n for n in table.column_names]
    pq.write_table(table.rename_columns(names), data)
    if column == "named so":
        info.write_text(info.read_text().replace('"action"', '"actions"'))
    assert convert_rollouts(root, tmp_path / "out") == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "actions" in said
    assert "ename" in said or "Give them the same names" in said
