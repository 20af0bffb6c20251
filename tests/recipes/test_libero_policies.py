"""LIBERO's demonstrations and the policies that learn from them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]

pytestmark = [pytest.mark.libero, pytest.mark.lerobot]


@pytest.mark.nightly
def test_every_config_is_a_policy_s(tmp_path):
    import draccus
    import yaml
    from lerobot.configs.train import TrainPipelineConfig

    import lerobot_roborecover.plugin  # noqa: F401
    from recipes.libero.train import POLICIES

    kinds = {}
    for file in (ROOT / "policies" / "train" / "libero").glob("*.yaml"):
        given = yaml.safe_load(file.read_text())
        base = given["policy"].pop("path", None)
        if base:  # goes on from a policy of the clone
            given["policy"]["type"] = json.loads((ROOT / base / "config.json").read_text())["type"]
        whole = tmp_path / file.name
        whole.write_text(yaml.safe_dump(given))
        config = draccus.parse(TrainPipelineConfig, whole, args=[])
        assert config.scheduler.num_decay_steps == config.steps, file.name
        kinds[file.stem] = config.policy.type
    assert sorted(kinds) == sorted(POLICIES)
    assert set(kinds.values()) == {"act", "diffusion", "tdmpc"}


def test_a_policy_learns_from_its_share_of_every_task_whatever_there_is_of_it(tmp_path):
    from recipes.libero.demonstrations import part_of, tasks_of
    from recipes.libero.train import POLICIES, episodes

    counts = [0, 16, 3] + [16] * 37
    for task, count in zip(tasks_of(None), counts, strict=True):
        np.savez(part_of(tmp_path, task), lengths=np.full(count, 9))
    assert episodes(POLICIES["act"], tmp_path) is None
    assert episodes(POLICIES["act_few"], tmp_path)[:8] == [0, 1, 2, 3, 16, 17, 18, 19]
    assert episodes(POLICIES["act_clean"], tmp_path)[:11] == [0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 19]


@pytest.mark.nightly
def test_what_stands_on_a_fixture_is_placed_on_it():
    """LIBERO's stored init states were drawn by the same rule, so a fresh place lies among them."""
    from lerobot_roborecover.platforms.libero.platform import PLATFORM
    from lerobot_roborecover.platforms.libero.scene import LiberoScene
    from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator
    from lerobot_roborecover.scenario import Reset
    from recipes.libero.demonstrations import FIRST_SEED, place_freshly

    task = next(t for t in PLATFORM.tasks() if t.name.startswith("pick_up_the_black_bowl_on_the_stove"))
    simulator = LiberoSimulator(obs_type="state")
    bowl, stored = "akita_black_bowl_1", []
    for i in range(0, 50, 5):
        simulator.reset(task, Reset(1000, i, PLATFORM.settle_steps))
        stored.append(LiberoScene(simulator).position_m(bowl).copy())
    for k in range(3):
        place_freshly(simulator, task, FIRST_SEED + k)
        placed = LiberoScene(simulator).position_m(bowl)
        assert np.all(np.abs(placed - np.mean(stored, axis=0))[:2] < 0.06), placed
        assert placed[2] > 0.9, placed  # metres: on the stove, not on the floor
    simulator.close()


SHIPPED = ROOT / "policies" / "libero"


def test_the_policies_in_the_clone_are_small_and_say_what_they_need():
    from lerobot_roborecover.platforms.libero.goal_state import ENVIRONMENT_STATE_DIM
    from recipes.libero.demonstrations import CAMERAS
    from recipes.libero.train import POLICIES

    names = {path.name for path in SHIPPED.iterdir()}
    assert {"act", "diffusion"} < names <= set(POLICIES)
    for name in names:
        pictures = POLICIES[name].pictures
        assert (SHIPPED / name / "model.safetensors").stat().st_size < (30e6 if pictures else 10e6), name
        config = json.loads((SHIPPED / name / "config.json").read_text())
        assert config["device"] == "cpu"
        shapes = {key: feature["shape"] for key, feature in config["input_features"].items()}
        seen = (
            {f"observation.images.{camera}": [3, 64, 64] for camera in CAMERAS}
            if pictures
            else {"observation.environment_state": [ENVIRONMENT_STATE_DIM]}
        )
        assert shapes == {"observation.state": [8]} | seen


STATE = ("--env.obs_type=state",)
PICTURES = (
    "--env.render_quality=fast", "--env.observation_height=64", "--env.observation_width=64"
)  # fmt: skip


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "looks"),
    [
        ("act", STATE), ("act_few", STATE), ("diffusion", STATE),
        pytest.param("act_pixels", PICTURES, marks=pytest.mark.render),
    ],
)  # fmt: skip
def test_a_policy_of_the_clone_solves_starts(name, looks, tmp_path):
    """Two of three easy ones: another processor may round a rollout the other way."""
    from lerobot_roborecover.cli.main import main
    from recipes.libero.initial_success import count, table

    given = ["--env.type=roborecover_libero", *looks, f"--policy.path={SHIPPED / name}"]
    starts = ["--task=libero_object/*butter*", "--task=libero_object/*milk*", "--task=libero_object/*salad*"]
    out = ["--init-states=0", "--frames=none", f"--name={name}", f"--out={tmp_path / name}"]
    main(["collect", *given, *starts, *out])  # where all are solved, it has nothing to write
    counts = count([tmp_path / f"{name}.work"])
    solved, tried = counts[name]["libero_object"]
    assert tried == 3
    assert solved >= 2
    assert f"| libero_object | {solved}/3 |" in table(counts)


@pytest.mark.nightly
@pytest.mark.render
@pytest.mark.parametrize("after", [(), (str(SHIPPED / "act_few"),)], ids=["expert", "after a policy"])
def test_an_episode_is_drawn_by_replaying_it(after, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from recipes.libero import demonstrations as made

    task = made.tasks_of(["libero_goal"])[7]  # the knob: short
    wanted = made.Wanted(task, 2, 32, made.part_of(tmp_path / "parts", task), after)
    assert "2 episodes" in made.make_part(wanted)
    with np.load(wanted.part) as part:
        states, lengths = part["observation.environment_state"], part["lengths"]
        assert not np.array_equal(part["start"][0], part["start"][1])
        assert (part["leads"] > 0).tolist() == [bool(after)] * 2
    made.draw_part(wanted)  # raises where the replay does not end in success
    pictures = LeRobotDataset("a/b", root=wanted.drawn)
    assert len(pictures) == lengths.sum() == len(states)
    assert pictures[0]["observation.images.image"].shape == (3, 32, 32)
    assert "observation.environment_state" not in pictures.features
    made.write_dataset(tmp_path / "numbers", [(task, wanted.part)])
    numbers = LeRobotDataset("a/b", root=tmp_path / "numbers")
    assert np.allclose(numbers[5]["observation.environment_state"], states[5])
    assert np.allclose(numbers[5]["action"], pictures[5]["action"])
