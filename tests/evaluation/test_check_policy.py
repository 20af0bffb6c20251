"""`roborecover check policy`: each mistake it looks for is found, and a sound policy passes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.evaluation import check_numbers as numbers
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.platforms.findings import Status
from tests.support.factories import fake_dataset, save_policy

pytestmark = pytest.mark.lerobot

RNG = np.random.default_rng(0)


def stats_of(low, high, mean=None) -> dict:
    low, high = np.asarray(low, float), np.asarray(high, float)
    middle = (low + high) / 2 if mean is None else np.asarray(mean, float)
    return {"min": low, "max": high, "mean": middle, "std": (high - low) / 4, "q01": low, "q99": high}


LIBERO = stats_of([-0.5, -0.4, 0.9, 2.0, -3.6, -1.8, 0.0, -0.04], [0.2, 0.4, 1.4, 3.7, 3.6, 1.3, 0.04, 0.0])
"""Statistics of LIBERO states: position, axis-angle, two fingers."""
UPRIGHT = np.array([-0.2, 0.0, 1.1, 3.1, 0.05, 0.0, 0.03, -0.03])


# --- numbers


def test_states():
    def check(states, stats=LIBERO, platform="libero"):
        return numbers.check_states(np.atleast_2d(states), stats, platform)

    assert check(UPRIGHT).status is Status.OK
    assert "not checked" in check(UPRIGHT, None).detail
    strayed = UPRIGHT + 0.9 * np.eye(8)[2]
    assert check(strayed).status is Status.WARNING, "one value off is what a recovery point may be"
    joints = np.array([0.0, -3.0, 9.0, -2.4, 8.0, 6.2, 5.8, 5.0])
    assert check(joints).status is Status.FAILURE
    assert "another robot" in check(joints).remedy


def test_the_other_quaternion_convention():
    """The published mistake: the antipodal quaternion's axis-angle, 2 pi less along the same axis."""
    turned = UPRIGHT.copy()
    turned[3:6] = numbers.other_axis_angle(UPRIGHT[None, 3:6])[0]
    found = numbers.check_states(turned[None], LIBERO, "libero")
    assert found.status is Status.FAILURE
    assert "quaternion" in found.remedy
    from scipy.spatial.transform import Rotation

    pair = [Rotation.from_rotvec(v[3:6]).as_matrix() for v in (UPRIGHT, turned)]
    np.testing.assert_allclose(*pair, atol=1e-9)


def recorded(gripper=(-1.0, 1.0), scale=0.3, count=400) -> np.ndarray:
    actions = RNG.normal(0, scale, (count, 7))
    actions[:, 6] = RNG.choice(gripper, count)
    return actions


def test_recorded_actions_and_gripper():
    trained = stats_of([-0.9] * 6 + [-1], [0.9] * 6 + [1])
    assert numbers.check_recorded_actions(recorded(), trained).status is Status.OK
    joints = stats_of([-300.0] * 7, [300.0] * 7)
    assert numbers.check_recorded_actions(recorded(), joints).status is Status.FAILURE
    columns = (6,)
    assert numbers.check_gripper(recorded(), trained, columns, False).status is Status.OK
    to_one = stats_of([-0.9] * 6 + [0], [0.9] * 6 + [1])
    assert numbers.check_gripper(recorded(), to_one, columns, False).status is Status.FAILURE
    assert numbers.check_gripper(recorded(), to_one, columns, True).status is Status.OK
    mostly_open = stats_of([-0.9] * 6 + [-1], [0.9] * 6 + [1], mean=[0] * 6 + [0.8])
    reversed_ = numbers.check_gripper(recorded((-1.0, -1.0, -1.0, 1.0)), mostly_open, columns, False)
    assert reversed_.status is Status.WARNING
    assert "sign" in reversed_.remedy


@pytest.mark.parametrize(
    ("stats", "mode", "words"),
    [
        (None, ("mean", "std"), "there are none"),
        ({"mean": np.zeros(3)}, ("mean", "std"), "std missing"),
        (stats_of([0, 0], [1, 1]), ("min", "max"), "2 values"),
        ({"mean": np.array([0, np.nan, 0]), "std": np.ones(3)}, ("mean", "std"), "not finite"),
        ({"mean": np.zeros(3), "std": np.zeros(3)}, ("mean", "std"), "std is 0"),
        (stats_of([0, 2, 0], [1, 1, 1]), ("q01", "q99"), "above"),
        (stats_of([0, 0, 0], [1, 1, 1]), ("q01", "q99"), ""),
    ],
)
def test_statistics(stats, mode, words):
    problem = numbers.statistics_problem(stats, mode, 3)
    assert words in problem
    assert bool(problem) == bool(words)


def test_pictures():
    upright = RNG.integers(0, 255, (24, 24, 3)).astype(np.uint8)
    seen = np.moveaxis(upright, -1, 0) / 255.0
    assert numbers.check_upright(seen, upright, "c").status is Status.OK
    turned = numbers.check_upright(seen[:, ::-1, ::-1], upright, "c")
    assert turned.status is Status.FAILURE
    assert turned.detail == "upside down"


def test_cameras_that_look_like_each_other():
    stats = {"a": {"mean": np.array([0.7, 0.6, 0.5])}, "b": {"mean": np.array([0.2, 0.2, 0.3])}}
    colours = {"a": np.array([0.68, 0.6, 0.5]), "b": np.array([0.2, 0.22, 0.3])}
    assert numbers.check_cameras_by_colour(colours, stats).status is Status.OK
    swapped = {"a": colours["b"], "b": colours["a"]}
    assert numbers.check_cameras_by_colour(swapped, stats).status is Status.WARNING
    assert numbers.check_cameras_by_colour(colours, {}) is None


def test_executed_actions():
    assert numbers.check_executed(RNG.uniform(-0.5, 0.5, (5, 7)), "libero").status is Status.OK
    assert numbers.check_executed(RNG.uniform(3, 9, (5, 7)), "libero").status is Status.WARNING
    assert numbers.check_executed(np.zeros((5, 7)), "libero").status is Status.WARNING
    assert numbers.check_executed(RNG.uniform(-2, 2, (5, 14)), "robotwin").status is Status.OK


# --- names


@pytest.mark.parametrize(
    ("cameras", "status"),
    [
        ({"agentview_image": "image", "robot0_eye_in_hand_image": "image2"}, Status.OK),
        ({"agentview_image": "image2", "robot0_eye_in_hand_image": "image"}, Status.WARNING),
        ({"agentview_image": "wrist", "robot0_eye_in_hand_image": "agent"}, Status.FAILURE),
        ({"head_camera": "camera1", "left_camera": "camera2", "right_camera": "camera3"}, Status.OK),
        ({"head_camera": "cam_high", "left_camera": "cam_right_wrist"}, Status.FAILURE),
        ({"head_camera": "cam_high", "left_camera": "cam_left_wrist"}, Status.OK),
        ({}, Status.OK),
    ],
)
def test_cameras_by_name(cameras, status):
    from lerobot_roborecover.evaluation.check_names import check_camera_names

    assert check_camera_names({c: f"observation.images.{k}" for c, k in cameras.items()}).status is status


def test_the_papers_horizons_are_those_of_the_configs():
    import yaml

    from lerobot_roborecover.evaluation.check_names import PAPER_HORIZON

    for (family, platform), horizon in PAPER_HORIZON.items():
        file = Path(__file__).parents[2] / "policies" / "eval" / f"{family}_{platform}.yaml"
        assert yaml.safe_load(file.read_text())["policy"]["n_action_steps"] == horizon


def test_a_horizon_that_is_not_the_papers():
    from types import SimpleNamespace

    from lerobot_roborecover.evaluation.check_names import check_horizon

    config = SimpleNamespace(type="pi05", n_action_steps=50, chunk_size=50)
    assert check_horizon(config, "libero", 220).status is Status.WARNING
    config.n_action_steps = 5
    assert check_horizon(config, "libero", 220).status is Status.OK
    assert check_horizon(config, "libero", 4).status is Status.WARNING, "one look for the whole trial"


# --- the command, on the fake simulator


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 2, horizon=8)


@pytest.fixture
def run(dataset, capfd, tmp_path):
    """Runs a command on a checkpoint; returns its status, stdout and stderr."""

    def call(command: str, policy: Path, *args: str) -> tuple[int, str, str]:
        capfd.readouterr()
        extra = (f"--output_dir={tmp_path / 'out'}",) if command == "eval" else ()
        status = main([
            command, "--env=roborecover_fake", f"--env.scenarios={dataset}", f"--policy.path={policy}",
            "--policy.device=cpu", "--eval.n_episodes=2", "--runner.slots=2", *extra, *args,
        ])  # fmt: skip
        return status, *capfd.readouterr()

    return call


def by_name(out: str) -> dict[str, dict]:
    report = json.loads(out)
    assert report["schema"] == 1
    assert report["ok"] == all(c["status"] != "failure" for c in report["checks"])
    return {c["name"]: c for c in report["checks"]}


def test_a_sound_policy_passes(run, tmp_path):
    policy = save_policy(tmp_path / "diffusion", "diffusion")
    status, out, _ = run("check-policy", policy, "--json")
    found = by_name(out)
    assert status == 0, out
    assert {c["status"] for c in found.values()} == {"ok"}, found
    assert "2 scenarios x 2 trials" in found["run time"]["value"]
    assert found["actions"]["value"].startswith("5 of width 2")
    assert set(found) >= {"loads", "weights", "normalisation", "inputs", "action width", "trials",
                          "inference time", "states fit the training data"}  # fmt: skip


def test_a_policy_that_rolls_back_first(dataset, capsys, tmp_path):
    base = save_policy(tmp_path / "act", "act")
    status = main([
        "check-policy", "--env=roborecover_fake", f"--env.scenarios={dataset}", "--policy.device=cpu",
        "--policy.type=roborecover_intervention", "--policy.mode=reversion", f"--policy.base.path={base}",
        "--eval.n_episodes=2", "--runner.slots=2", "--json",
    ])  # fmt: skip
    shown = capsys.readouterr()
    found = by_name(shown.out)
    assert status == 0, found
    assert found["actions"]["value"].startswith("5 of width 2")
    for meaningless in ("random weights", "infinite values", "No job name"):
        assert meaningless not in shown.err


def test_a_table_with_remedies(run, tmp_path):
    """ACT is deterministic, which is a warning; its normaliser has no statistics, which is a failure."""
    policy = save_policy(tmp_path / "act", "act")
    for file in policy.glob("*normalizer_processor.safetensors"):
        file.unlink()
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        saved = json.loads((policy / name).read_text())
        for step in saved["steps"]:
            step.pop("state_file", None)
        (policy / name).write_text(json.dumps(saved))
    status, out, _ = run("check-policy", policy)
    assert status == 1
    assert "failure  normalisation: observation.state (MEAN_STD): there are none" in out
    assert "warning  trials: 2 a scenario, and the policy does the same in each" in out
    assert "-> " in out
    assert "1 failures" in out.splitlines()[-1]


@pytest.mark.parametrize("command", ["check-policy", "eval"])
def test_a_checkpoint_without_processor_files(run, tmp_path, command):
    policy = save_policy(tmp_path / "act", "act")
    for file in policy.glob("policy_p*processor*"):
        file.unlink()
    status, out, errors = run(command, policy)
    assert status == (1 if command == "check-policy" else 2)
    text = " ".join((out if command == "check-policy" else errors).split())
    assert "no processor files" in text
    assert "migrate_policy_normalization" in text


@pytest.mark.parametrize("command", ["check-policy", "eval"])
def test_a_checkpoint_for_another_robot(run, tmp_path, command):
    policy = save_policy(tmp_path / "act", "act", action=7)
    status, out, errors = run(command, policy)
    assert status == (1 if command == "check-policy" else 2)
    text = " ".join((out if command == "check-policy" else errors).split())
    assert "7" in text
    assert "another robot" in text


def picture_inputs(*cameras: str) -> dict:
    from lerobot.configs import FeatureType, PolicyFeature

    pictures = {f"observation.{c}": PolicyFeature(FeatureType.VISUAL, (3, 64, 64)) for c in cameras}
    return {"observation.state": PolicyFeature(FeatureType.STATE, (8,)), **pictures}


@pytest.mark.parametrize(
    ("platform", "options", "cameras", "observed", "said"),
    [
        ("fake", {}, ["image"], None, "give --env.obs_type=pixels_agent_pos"),
        (
            "libero", {"camera_name": "agentview_image"}, ["images.image", "images.image2"],
            ["observation.state", "observation.images.image"],
            "give --env.camera_name=agentview_image,robot0_eye_in_hand_image",
        ),
        (
            "libero", {}, ["images.front", "images.image2"], None,
            'give --rename_map=\'{"observation.images.image": "observation.images.front"}\'; else take a '
            "checkpoint that was trained on observation.images.image, observation.images.image2",
        ),
        (
            "metaworld", {}, ["image", "images.wrist"], None,
            "no option of roborecover_metaworld gives observation.images.wrist: take a checkpoint whose "
            "inputs are among what it gives (observation.image, observation.state)",
        ),
        ("robotwin", {}, ["images.mosaic"], None, "give --env.mosaic=true"),
        (
            "robotwin", {"camera_names": "head_camera"}, ["images.head_camera", "images.left_camera"], None,
            "give --env.camera_names=head_camera,left_camera,right_camera",
        ),
        ("libero", {"obs_type": "state"}, ["images.empty_camera_0"], None, ""),
    ],
)  # fmt: skip
def test_what_gives_a_camera_that_is_missing(platform, options, cameras, observed, said):
    """An option of the environment where one does; a map only where a camera of another name is spare."""
    from lerobot_roborecover.evaluation.check_names import input_remedy
    from lerobot_roborecover.evaluation.env_configs import env_type

    found = input_remedy(env_type(platform)(**options), picture_inputs(*cameras), {}, observed)
    assert found.endswith(said) if said else not found
    assert ("--rename_map" in found) == ("--rename_map" in said)


@pytest.mark.parametrize("command", ["check-policy", "eval"])
def test_a_camera_that_the_environment_lacks(run, tmp_path, command):
    """LeRobot's own words on such a mismatch propose a rename map."""
    images = ("observation.images.front", "observation.images.wrist")
    policy = save_policy(tmp_path / "act", "act", images=images)
    status, out, errors = run(command, policy, "--env.obs_type=pixels_agent_pos")
    text = " ".join((out if command == "check-policy" else errors).split())
    assert status == (1 if command == "check-policy" else 2), text
    assert "no option of roborecover_fake gives observation.images.front, observation.images.wrist" in text
    assert "rename_map" not in text


def test_a_state_of_another_width(run, tmp_path):
    """The table says what is wrong, so the policy is not asked: it would only raise, with a traceback."""
    policy = save_policy(tmp_path / "act", "act", state=9)
    status, out, errors = run("check-policy", policy, "--json")
    assert status == 1
    assert "actions" not in by_name(out)
    assert "Traceback" not in errors
    inputs = by_name(out)["inputs"]
    assert inputs["status"] == "failure"
    assert "(4,)" in inputs["value"]
    assert "(9,)" in inputs["value"]


def nan_policy(folder: Path) -> Path:
    from safetensors.torch import load_file, save_file

    policy = save_policy(folder, "act")
    weights = load_file(policy / "model.safetensors")
    weights["model.action_head.bias"][:] = float("nan")
    save_file(weights, policy / "model.safetensors")
    return policy


def test_actions_that_are_not_numbers(run, tmp_path, run_lerobot_eval, dataset):
    """`eval` stops with the cause and no row; under `lerobot-eval` every trial is a `policy_error` row.
    The simulator never sees an action."""
    policy = nan_policy(tmp_path / "act")
    status, out, _ = run("check-policy", policy, "--json")
    assert status == 1
    assert "non-finite" in by_name(out)["actions"]["value"]
    status, out, err = run("eval", policy)
    assert status == 1
    assert "Recovery success" not in out
    told = err.strip().splitlines()[-1]
    assert "the first 3 trials ended in the same policy error" in told
    assert "non-finite" in told
    assert "check policy" in told
    assert read_trial_log(tmp_path / "out" / "trials.jsonl") == []
    stock = run_lerobot_eval(
        "--env=roborecover_fake", f"--env.scenarios={dataset}", f"--policy.path={policy}",
        "--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false", out="stock",
    )  # fmt: skip
    rows = read_trial_log(stock / "trials.jsonl")
    assert [(r.outcome, r.steps) for r in rows] == [("policy_error", 0)] * 4
    assert all("non-finite" in r.reason and "not sent" in r.reason for r in rows)


def test_weights_that_were_not_loaded(tmp_path):
    """LeRobot's π0 and π0.5 print a warning and go on with random weights."""
    from lerobot.policies import get_policy_class

    from lerobot_roborecover.evaluation.check_names import check_weights

    folder = save_policy(tmp_path / "act", "act")
    policy = get_policy_class("act").from_pretrained(folder)
    assert check_weights(policy, str(folder)).status is Status.OK
    for parameter in policy.parameters():
        parameter.data.normal_()
    found = check_weights(policy, str(folder))
    assert found.status is Status.FAILURE
    assert "random weights" in found.remedy


@pytest.mark.parametrize(
    ("args", "words"),
    [(["--check.steps=0"], "check.steps=0"), (["--env.select=suite=nowhere"], "nowhere")],
)
def test_refusals(run, tmp_path, args, words):
    status, _, errors = run("check-policy", save_policy(tmp_path / "act", "act"), *args)
    assert status == 2
    assert words in errors
