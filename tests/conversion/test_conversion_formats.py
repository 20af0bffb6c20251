"""HDF5 demonstrations and recorded rollouts to trajectory datasets, honest about what can be replayed."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest

from lerobot_roborecover.datasets.trajectories import read_trajectories
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.libero.init_states import read_init_states
from lerobot_roborecover.scenario import ScenarioError
from tests.support.conversion_scripts import script

h5py = pytest.importorskip("h5py", reason="no h5py: pip install 'lerobot_env_roborecover[hdf5]'")
pytestmark = pytest.mark.lerobot

TASK = "put_the_bowl_on_the_plate"


def libero_file(path, demos=2, steps=6, robomimic=False, dtype=np.float64, pause=True, init=True):
    """A file as LIBERO writes it, or with robomimic's names."""
    rng = np.random.default_rng(0)
    state = read_init_states("libero_goal", TASK)[3]
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["bddl_file_name"] = f"libero/libero/bddl_files/libero_goal/{TASK}.bddl"
        for i in range(demos):
            demo = data.create_group(f"demo_{i}")
            actions = rng.uniform(-1, 1, (steps, 7)).astype(dtype)
            if pause:
                actions[2, :6] = 0
            demo["actions"] = actions
            first = state.copy()
            first[0] += 0.25
            first[3] += 0 if init else 1e-6
            demo["states"] = np.stack([first] + [state + 1] * (steps - 1))
            demo["rewards"] = np.array([0] * (steps - 1) + [1], np.uint8)
            pictures = rng.integers(0, 256, (steps, 32, 32, 3), dtype=np.uint8)
            obs = demo.create_group("obs")
            if robomimic:
                obs["agentview_image"] = obs["robot0_eye_in_hand_image"] = pictures
                obs["robot0_eef_pos"] = rng.uniform(-1, 1, (steps, 3))
                obs["robot0_eef_quat"] = np.tile([0.0, 0.0, 0.0, 1.0], (steps, 1))
                obs["robot0_gripper_qpos"] = rng.uniform(-1, 1, (steps, 2))
            else:
                obs["agentview_rgb"] = obs["eye_in_hand_rgb"] = pictures
                obs["ee_states"] = rng.uniform(-1, 1, (steps, 6))
                obs["gripper_states"] = rng.uniform(-1, 1, (steps, 2))
    return path


@pytest.mark.parametrize("robomimic", [False, True])
def test_libero_demonstrations_become_rollouts_with_exact_actions(tmp_path, capsys, robomimic):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    path = libero_file(tmp_path / f"{TASK}_demo.hdf5", robomimic=robomimic)
    assert script("libero_hdf5").main([str(path), "--out", str(tmp_path / "out")]) == 0
    assert (
        "2 trajectories, 2 successful, 0 replayable exactly; 0 refused\n  2: fixture poses"
        in capsys.readouterr().out
    )
    found = read_trajectories(tmp_path / "out")
    dataset = LeRobotDataset("lab/x", root=tmp_path / "out")
    with h5py.File(path) as file:
        for i, actions in enumerate(found.actions()):
            assert actions.tobytes() == file[f"data/demo_{i}/actions"][()].tobytes()
        obs = file["data/demo_0/obs"]
        place = obs["robot0_eef_pos"][1] if robomimic else obs["ee_states"][1][:3]
        np.testing.assert_allclose(dataset[1]["observation.state"][:3], place, atol=1e-6)
        # LeRobot shows policies the upright picture, the file holds it rotated by 180 degrees.
        stored = obs["agentview_image" if robomimic else "agentview_rgb"][0][::-1, ::-1]
        seen = dataset[0]["observation.images.image"].numpy().transpose(1, 2, 0) * 255
        assert np.abs(seen - stored).mean() < np.abs(seen - stored[::-1, ::-1]).mean()
    row = found.rows[0]
    assert (row.task["suite"], row.task["name"], row.success, row.driver) == (
        "libero_goal",
        TASK,
        True,
        "human",
    )
    assert row.provenance == {"file": path.name, "episode": "demo_0", "init_state_index": 3}
    assert row.not_replayable == "fixture poses are not recorded"


def test_every_reason_against_an_exact_replay_is_named(tmp_path):
    path = libero_file(tmp_path / "x.hdf5", demos=1, dtype=np.float32, pause=False, init=False)
    assert script("libero_hdf5").main([str(path), "--out", str(tmp_path / "out")]) == 0
    (row,) = read_trajectories(tmp_path / "out").rows
    assert row.not_replayable.split("; ") == [
        "fixture poses are not recorded",
        "actions are float32",
        "no action is a no-op: they were probably taken out",
        "the first state is none of the task's stored init states",
    ]


def test_a_bad_demonstration_is_named_and_the_rest_goes_on(tmp_path, capsys):
    path = libero_file(tmp_path / "x.hdf5", demos=4)
    secret = tmp_path / "secret.hdf5"
    with h5py.File(secret, "w") as file:
        file["actions"] = np.zeros((6, 7))
    with h5py.File(path, "a") as file:
        file["data/demo_0/actions"][3, 2] = np.nan
        del file["data/demo_1/actions"]
        file["data/demo_1/actions"] = h5py.ExternalLink(str(secret), "actions")
        del file["data/demo_2/actions"]
        file["data/demo_2/actions"] = np.zeros((6, 8))
    assert script("libero_hdf5").main([str(path), "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr()
    for words in (
        "demo_0/actions holds NaN",
        "demo_1/actions is a link to another file",
        "demo_2/actions has shape",
    ):
        assert words in said.err
    assert "1 trajectories" in said.out


def test_raw_demonstrations_are_named_and_the_good_file_beside_them_is_kept(tmp_path, capsys):
    good, raw, other = (libero_file(tmp_path / f"{name}.hdf5") for name in ("good", "raw", "other"))
    with h5py.File(raw, "a") as file:
        del file["data/demo_0/obs"], file["data/demo_1/obs"]
    with h5py.File(other, "a") as file:
        del file["data"]
    arguments = [str(raw), str(other), str(good), str(tmp_path / "none.hdf5")]
    assert script("libero_hdf5").main([*arguments, "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr()
    lines = [line for line in said.err.splitlines() if str(tmp_path) in line]
    assert len(lines) == 4
    assert all(f"{raw}: /data/demo_{i}/obs is missing: raw demonstrations" in lines[i] for i in (0, 1))
    assert f"{other}: /data is missing: it is not a LIBERO or robomimic file" in lines[2]
    assert f"{tmp_path / 'none.hdf5'} cannot be opened as HDF5" in lines[3]
    assert "2 trajectories" in said.out
    assert "4 refused" in said.out
    assert {r.provenance["file"] for r in read_trajectories(tmp_path / "out").rows} == {"good.hdf5"}


def test_observations_of_another_file_or_form_are_refused(tmp_path, capsys):
    path, secret = (libero_file(tmp_path / f"{name}.hdf5", demos=3) for name in ("x", "secret"))
    with h5py.File(path, "a") as file:
        del file["data/demo_0/obs"], file["data/demo_1/obs"]
        file["data/demo_0/obs"] = h5py.ExternalLink(str(secret), "data/demo_0/obs")
        file["data/demo_1/obs"] = np.zeros(3)
    assert script("libero_hdf5").main([str(path), "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert "demo_0/obs is a link to another file" in said
    assert "demo_1/obs is not a group" in said


def test_demonstrations_with_other_cameras_are_refused_in_one_line(tmp_path, capsys):
    path = libero_file(tmp_path / "x.hdf5")
    with h5py.File(path, "a") as file:
        del file["data/demo_1/obs/eye_in_hand_rgb"]
    assert script("libero_hdf5").main([str(path), "--out", str(tmp_path / "out")]) == 2
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith("libero_hdf5: ")
    assert "observation.images.image2" in line


@pytest.mark.parametrize("text", [b"", b"\x80\x04pickle", b"\x89HDF\r\n\x1a\n"])
def test_what_is_no_hdf5_is_refused_and_leaves_nothing(tmp_path, capsys, text):
    (tmp_path / "x.hdf5").write_bytes(text)
    assert script("libero_hdf5").main([str(tmp_path / "x.hdf5"), "--out", str(tmp_path / "out")]) == 2
    assert "cannot be opened as HDF5" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def jpeg(color) -> bytes:
    """A picture as RoboTwin stores it: RGB given to an encoder that expects BGR."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.new("RGB", (32, 24), tuple(color[::-1])).save(buffer, "JPEG", quality=95)
    return buffer.getvalue()


def robotwin_folder(root, episodes=2, states=5):
    folder = root / "stack_blocks_two" / "demo_clean"
    (folder / "data").mkdir(parents=True)
    (folder / "instructions").mkdir()
    (folder / "seed.txt").write_text("7 11 ")
    rng = np.random.default_rng(1)
    for i in range(episodes):
        said = {"seen": [f"seen {i}"], "unseen": [f"unseen {i}", "other"]}
        (folder / "instructions" / f"episode{i}.json").write_text(json.dumps(said))
        with h5py.File(folder / "data" / f"episode{i}.hdf5", "w") as file:
            file["joint_action/vector"] = rng.uniform(-2, 2, (states, 14))
            pictures = [jpeg((250, 20, 20)).ljust(2000, b"\0") for _ in range(states)]
            for camera in ("head_camera", "left_camera", "right_camera"):
                file.create_dataset(f"observation/{camera}/rgb", data=pictures, dtype="S2000")
    return folder


def test_robotwin_episodes_become_rollouts_that_say_they_cannot_be_replayed(tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    folder = robotwin_folder(tmp_path)
    assert script("robotwin_hdf5").main([str(folder), "--out", str(tmp_path / "out")]) == 0
    found = read_trajectories(tmp_path / "out")
    assert [r.provenance["seed"] for r in found.rows] == [7, 11]
    assert [r.task["instruction"] for r in found.rows] == ["unseen 0", "unseen 1"]
    assert {(r.task["suite"], r.task["horizon"]) for r in found.rows} == {("demo_clean", 800)}
    assert all("not the commanded actions" in r.not_replayable for r in found.rows)
    dataset = LeRobotDataset("lab/x", root=tmp_path / "out")
    with h5py.File(folder / "data" / "episode0.hdf5") as file:
        joints = file["joint_action/vector"][()]
    assert found.actions()[0].tobytes() == joints[1:].tobytes()
    np.testing.assert_allclose(dataset[0]["observation.state"], joints[0], atol=1e-6)
    red, green, _ = dataset[0]["observation.images.head_camera"].numpy().mean(axis=(1, 2))
    assert red > 0.8 > 0.3 > green


@pytest.mark.parametrize("robomimic", [False, True])
@pytest.mark.parametrize("observations", [12, 3])
def test_actions_and_observations_of_other_numbers_are_refused_by_name(
    tmp_path, capsys, robomimic, observations
):
    path = libero_file(tmp_path / "x.hdf5", demos=1, steps=observations, robomimic=robomimic)
    with h5py.File(path, "a") as file:
        del file["data/demo_0/actions"]
        file["data/demo_0/actions"] = np.zeros((5, 7))
        del file["data/demo_0/states"], file["data/demo_0/rewards"]
    assert script("libero_hdf5").main([str(path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert f"has {observations} rows, but there are 5 actions" in said
    assert "demo_0/obs/agentview" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["states", "rewards"])
def test_states_and_rewards_of_another_number_than_actions_are_refused(tmp_path, capsys, name):
    path = libero_file(tmp_path / "x.hdf5", demos=1)
    with h5py.File(path, "a") as file:
        values = file[f"data/demo_0/{name}"][()]
        del file[f"data/demo_0/{name}"]
        file[f"data/demo_0/{name}"] = values[:-1]
    assert script("libero_hdf5").main([str(path), "--out", str(tmp_path / "out")]) == 2
    assert f"demo_0/{name} has 5 rows, but there are 6 actions" in capsys.readouterr().err


def test_robotwin_pictures_of_another_number_than_states_are_refused(tmp_path, capsys):
    folder = robotwin_folder(tmp_path, episodes=1)
    with h5py.File(folder / "data" / "episode0.hdf5", "a") as file:
        pictures = file["observation/left_camera/rgb"][()]
        del file["observation/left_camera/rgb"]
        file["observation/left_camera/rgb"] = pictures[:3]
    assert script("robotwin_hdf5").main([str(folder), "--out", str(tmp_path / "out")]) == 2
    assert "left_camera/rgb has 3 rows, but there are 5 joint states" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["libero_hdf5", "robotwin_hdf5", "roborecover_release"])
def test_a_licence_that_nobody_knows_is_refused_before_anything_is_read(tmp_path, capsys, name):
    arguments = [str(tmp_path / "none"), "--out", str(tmp_path / "out"), "--license"]
    with pytest.raises(SystemExit) as end:
        script(name).main([*arguments, "cc-by-40"])
    assert end.value.code == 2
    assert "do you mean cc-by-4.0" in capsys.readouterr().err
    assert script(name).main([*arguments, "CC-BY-4.0"]) == 2
    assert "that the Hub knows" not in capsys.readouterr().err


def test_robotwin_episodes_without_instruction_or_pictures_are_named(tmp_path, capsys):
    folder = robotwin_folder(tmp_path, episodes=5)
    (folder / "instructions" / "episode0.json").write_text("{}")
    (folder / "seed.txt").write_bytes(b"7 11 13 \xff\xfe 17")
    with h5py.File(folder / "data" / "episode4.hdf5", "a") as file:
        del file["observation"]
    (folder / "data" / "episode_new.hdf5").touch()
    with h5py.File(folder / "data" / "episode1.hdf5", "a") as file:
        del file["observation/head_camera/rgb"]
    empty = tmp_path / "stack_bowls_two" / "demo_clean"
    empty.mkdir(parents=True)
    assert script("robotwin_hdf5").main([str(empty), str(folder), "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert f"{empty} has no data/episode*.hdf5" in said
    assert "seed.txt: '\ufffd\ufffd' is not a whole number" in said
    assert "/observation is missing" in said
    assert "episode_new.hdf5: " in said
    assert "episode0.json, field unseen" in said
    assert "observation/head_camera/rgb is missing" in said


def test_tasks_are_found_by_name_and_by_instruction():
    assert platform_named("libero").task(TASK).suite == "libero_goal"
    assert platform_named("libero").task_by_instruction("Put the bowl  on the plate").name == TASK
    assert platform_named("robotwin").task("open_microwave", "open it").horizon == 1500
    for call, words in (
        (lambda: platform_named("libero").task("fly"), "libero has no task 'fly'; there are "),
        (lambda: platform_named("robotwin").task("../x"), "not one of RoboTwin's 50 tasks"),
        (lambda: platform_named("libero").task_by_instruction("fly"), "0 tasks"),
    ):
        with pytest.raises(ScenarioError, match=words):
            call()
