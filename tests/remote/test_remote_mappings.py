"""Mappings: what each family's server is sent and answers, and the servers for environments of their own."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from lerobot_roborecover.policies.remote.errors import (
    MappingError,
    RemoteError,
    WireError,
)
from lerobot_roborecover.policies.remote.mapping import load_mapping, parse_mapping
from lerobot_roborecover.policies.remote.translate import Translator, quat_xyzw, resize
from tests.support.policy_servers import ask, openpi_client, standalone  # noqa: F401 - fixtures

SERVERS = Path(__file__).parents[2] / "policies" / "servers"


HEAD = "version: 1\nabout: a server\n"
STATE = HEAD + "state: [{key: s, parts: [{slice: [0, 3]}]}]\n"

# --- translation: each family's own client, written down from what its repository does with robosuite's data


def robosuite(quat=(0.6, -0.3, 0.2, -0.714)):
    """Raw observation of LIBERO, and what LeRobot's processor makes of it."""
    rng = np.random.default_rng(0)
    quat = np.array(quat) / np.linalg.norm(quat)
    axis_angle = quat[:3] * 2 * np.arccos(quat[3]) / np.sqrt(1 - quat[3] ** 2)
    raw = {
        "agent": rng.integers(0, 256, (256, 256, 3), np.uint8),
        "wrist": rng.integers(0, 256, (256, 256, 3), np.uint8),
        "pos": np.array([0.1, 0.2, 1.0]), "quat": quat, "axis_angle": axis_angle,
        "gripper": np.array([0.04, -0.04]),
    }  # fmt: skip
    ours = {
        f"observation.images.{name}": np.float32(raw[camera][::-1, ::-1].transpose(2, 0, 1)) / np.float32(255)
        for name, camera in (("image", "agent"), ("image2", "wrist"))
    }
    state = np.concatenate([raw["pos"], axis_angle, raw["gripper"]]).astype(np.float32)
    return raw, {**ours, "observation.state": state}


def request_of(name, observation, task="Put the BOWL down"):
    translator = Translator(load_mapping(name))
    return translator.request([translator.frame(observation)] * translator.frames, task)


def check(request, expected):
    assert set(request) == set(expected)
    for key, value in expected.items():
        if not isinstance(value, np.ndarray):
            assert request[key] == value, key
        else:
            assert request[key].shape == value.shape, key
            assert request[key].dtype == value.dtype, key
            np.testing.assert_allclose(request[key], value, atol=2e-7, err_msg=key)


def test_openpi_libero_is_asked_as_by_its_own_client(openpi_client):  # noqa: F811
    from openpi_client import image_tools

    raw, ours = robosuite()

    def picture(camera):
        return image_tools.resize_with_pad(np.ascontiguousarray(raw[camera][::-1, ::-1]), 224, 224)

    check(
        request_of("openpi_libero", ours),
        {
            "observation/image": picture("agent"),
            "observation/wrist_image": picture("wrist"),
            "observation/state": np.concatenate([raw["pos"], raw["axis_angle"], raw["gripper"]]),
            "prompt": "Put the BOWL down",
        },
    )


@pytest.mark.parametrize("size", [(224, 224), (100, 300), (300, 100)])
@pytest.mark.parametrize("shape", [(240, 320, 3), (97, 51, 3)])
def test_padding_is_openpis(openpi_client, shape, size):  # noqa: F811
    from openpi_client import image_tools

    picture = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    np.testing.assert_array_equal(resize(picture, size, "pad"), image_tools.resize_with_pad(picture, *size))
    assert resize(picture, size, "stretch").shape == (*size, 3)


@pytest.mark.parametrize("sign", [1, -1])
def test_cosmos_policy_sees_what_its_own_client_sends(sign):
    """The quaternion keeps its sign, and the pictures are flipped upside down, not turned."""
    raw, ours = robosuite(quat=sign * np.array([0.6, -0.3, 0.2, 0.714]))
    check(
        request_of("cosmos_policy", ours),
        {
            "primary_image": np.flipud(raw["agent"]),
            "wrist_image": np.flipud(raw["wrist"]),
            "proprio": np.concatenate([raw["gripper"], raw["pos"], raw["quat"]]),
            "task_description": "Put the BOWL down",
        },
    )


def test_no_rotation_is_a_quaternion_too():
    np.testing.assert_array_equal(quat_xyzw(np.zeros(3)), [0, 0, 0, 1])


def test_being_h05_sees_what_its_own_client_sends():
    raw, ours = robosuite()
    check(
        request_of("being_h05", ours),
        {
            "video.top_view": raw["agent"][None, ::-1, ::-1],
            "video.wrist_view": raw["wrist"][None, ::-1, ::-1],
            "state.state": np.concatenate([raw["pos"], raw["axis_angle"], raw["gripper"]])[None],
            "state.eef_position": raw["pos"][None],
            "state.eef_rotation": raw["axis_angle"][None],
            "state.libero_gripper_position": raw["gripper"][None],
            "language.instruction": ["Put the BOWL down"],
        },
    )


def test_unifolm_vla_sees_two_steps():
    raw, ours = robosuite()
    request = request_of("unifolm_vla", ours)
    assert set(request) == {"observations", "instruction"}
    assert len(request["observations"]) == 2
    state = np.concatenate([raw["pos"], raw["axis_angle"], raw["gripper"]])
    pictures = {"full_image": raw["agent"][::-1, ::-1], "wrist_image": raw["wrist"][::-1, ::-1]}
    check(request["observations"][1], {**pictures, "state": state})


def test_lingbot_vla_sees_three_cameras_and_joints():
    rng = np.random.default_rng(0)
    frames = {c: rng.integers(0, 256, (240, 320, 3), np.uint8) for c in ("head", "left", "right")}
    ours = {
        f"observation.images.{c}_camera": np.float32(f.transpose(2, 0, 1)) / np.float32(255)
        for c, f in frames.items()
    }
    joints = np.arange(14, dtype=np.float32)
    check(
        request_of("lingbot_vla", {**ours, "observation.state": joints}),
        {
            "observation.images.cam_high": frames["head"],
            "observation.images.cam_left_wrist": frames["left"],
            "observation.images.cam_right_wrist": frames["right"],
            "observation.state": joints,
            "task": "Put the BOWL down",
        },
    )


def test_an_observation_that_does_not_fit_is_named():
    _, ours = robosuite()
    with pytest.raises(MappingError, match=r"wants 'observation.images.image2'.*gives.*observation.state"):
        request_of("openpi_libero", {k: v for k, v in ours.items() if "image2" not in k})
    with pytest.raises(MappingError, match=r"shape \(4,\).*\[0, 8\]"):
        request_of("openpi_libero", {**ours, "observation.state": np.zeros(4, np.float32)})
    with pytest.raises(MappingError, match="from 0 to 1"):
        request_of("openpi_libero", {**ours, "observation.images.image": np.full((3, 8, 8), np.nan)})


def actions_of(name, chunk):
    return Translator(load_mapping(name)).actions({"actions": chunk, "action": chunk})


@pytest.mark.parametrize(
    ("name", "steps", "grips"),
    [
        ("openpi_libero", 5, {-1.0: -1.0, 0.25: 0.25, 1.0: 1.0}),
        ("being_h05", 8, {1.0: -1.0, 0.0: 1.0, 0.5: 0.0}),
        ("unifolm_vla", 8, {0.9: -1.0, 0.51: -1.0, 0.1: 1.0}),
        ("cosmos_policy", 16, {-1.0: -1.0, 1.0: 1.0}),
    ],
)
def test_actions_become_ours(name, steps, grips):
    for given_value, ours in grips.items():
        chunk = np.random.default_rng(0).normal(size=(20, 7)).astype(np.float32)
        chunk[:, 6] = given_value
        actions = actions_of(name, chunk)
        assert actions.shape == (steps, 7)
        np.testing.assert_array_equal(actions[:, :6], chunk[:steps, :6])
        np.testing.assert_allclose(actions[:, 6], ours, atol=1e-6)


def test_lingbot_answers_whole_or_in_parts():
    chunk = np.random.default_rng(0).normal(size=(50, 14)).astype(np.float32)
    arms, grippers = np.delete(chunk, [6, 13], axis=1), chunk[:, [6, 13]]
    translator = Translator(load_mapping("lingbot_vla"))
    parts = {"action.arm.position": arms, "action.effector.position": grippers}
    for answer in ({"action": chunk}, parts):
        np.testing.assert_array_equal(translator.actions(answer), chunk[:25])
    with pytest.raises(WireError, match=r"shapes \[\(50, 12\), \(49, 2\)\]"):
        translator.actions({**parts, "action.effector.position": grippers[1:]})
    with pytest.raises(WireError, match=r"has no 'action.effector.position'"):
        translator.actions({"action.arm.position": arms})


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ({"action": 1}, "has no 'actions'"),
        ([1, 2], "has no 'actions'"),
        ({"actions": [[0.0] * 7]}, "is a list, not an array"),
        ({"actions": np.zeros(7)}, r"shape \(7,\)"),
        ({"actions": np.zeros((2, 5, 7))}, r"shape \(2, 5, 7\)"),
        ({"actions": np.zeros((0, 7))}, r"shape \(0, 7\)"),
        ({"actions": np.zeros((8, 6))}, "actions of width 6.*columns"),
        ({"actions": np.zeros((3, 7))}, "3 actions, fewer than the 8"),
        ({"actions": np.full((8, 7), np.nan)}, "non-finite"),
    ],
)
def test_a_server_that_lies(answer, words):
    with pytest.raises(WireError, match=words):
        # A gripper threshold must not turn NaN into an action.
        Translator(load_mapping("unifolm_vla")).actions(answer)


def test_scale_offset_and_horizon():
    mapping = parse_mapping(STATE + "actions: {columns: [1, 0], scale: [2.0, 1.0], offset: [0.0, 5.0]}", "m")
    actions = Translator(mapping, execute=2).actions({"actions": np.array([[1.0, 2.0], [3, 4], [5, 6]])})
    np.testing.assert_array_equal(actions, [[4, 6], [8, 8]])


# --- the servers for environments of their own


def modules(monkeypatch, **names):
    """Stand-ins for modules of a family's repository."""
    for path, content in names.items():
        path = path.replace("__", ".")
        for depth in range(1, path.count(".") + 1):
            parent = ".".join(path.split(".")[:depth])
            monkeypatch.setitem(sys.modules, parent, sys.modules.get(parent) or ModuleType(parent))
        module = ModuleType(path)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, path, module)
        if "." in path:
            monkeypatch.setattr(sys.modules[path.rpartition(".")[0]], path.rpartition(".")[2], module, False)


def being(monkeypatch, seen):
    class BeingHPolicy:
        def __init__(self, **options):
            seen.append(options)

        def get_action(self, observations):
            seen.append(observations)
            keys = ("action.eef_position", "action.eef_rotation", "action.gripper_position")
            return {key: np.zeros((1, 16, n)).tolist() for key, n in zip(keys, (3, 3, 1), strict=True)}

    modules(
        monkeypatch,
        BeingH__inference__beingh_policy={"BeingHPolicy": BeingHPolicy},
        torch={"manual_seed": seen.append, "cuda": SimpleNamespace(is_available=lambda: False)},
    )
    return ("checkpoint",)


SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")


def unifolm(monkeypatch, seen):
    def get_action_state(frames, task, model):
        seen.append({"frames": list(frames), "task": task, "statistics": model.action_norm_stats})
        return np.zeros((8, 7))

    class Inference:
        def __init__(self, **options):
            seen.append(options)

        @staticmethod
        def get_action_stats(key, path):
            return f"actions of {key}"

        get_state_stats = get_action_stats

    class Suite:
        n_tasks = 1
        languages = iter(("a", "b", "Put the BOWL down", "c"))

        def __init__(self):
            self.language = next(self.languages)

        def get_task(self, index):
            return self

    modules(
        monkeypatch,
        experiments__LIBERO__eval_libero={"get_action_state": get_action_state},
        experiments__LIBERO__libero_utils={"resize_image_for_policy": lambda p, size: p[:size, :size]},
        experiments__LIBERO__unifolm_vla_inference={"Unifolm_VLA_Inference": Inference},
        unifolm_vla__rlds_dataloader__constants={"NUM_ACTIONS_CHUNK": 8},
        libero__libero__benchmark={"get_benchmark_dict": lambda: dict.fromkeys(SUITES, Suite)},
    )
    return ("checkpoint", "vlm")


def cosmos(monkeypatch, seen):
    def get_action(config, model, stats, observation, task, **options):
        seen.append({**observation, "task": task})
        return {"actions": [np.zeros(7)] * 16}

    modules(
        monkeypatch,
        cosmos_policy__experiments__robot__cosmos_utils={
            "get_action": get_action, "get_model": lambda c: ("model", None),
            "load_dataset_stats": lambda p: {}, "init_t5_text_embeddings_cache": lambda p: None,
        },
        cosmos_policy__experiments__robot__libero__run_libero_eval={
            "PolicyEvalConfig": lambda **o: seen.append(o) or SimpleNamespace(**o)
        },
        cosmos_policy__utils__utils={"set_seed_everywhere": lambda s: None},
    )  # fmt: skip
    return ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "module", "family", "steps"),
    [
        ("being_h05", "being_h05_libero", being, 8),
        ("unifolm_vla", "unifolm_vla_libero", unifolm, 8),
        ("cosmos_policy", "cosmos_policy_libero", cosmos, 16),
    ],
)
def test_mapping_and_server_of_a_family_fit(standalone, monkeypatch, name, module, family, steps):  # noqa: F811
    """Our two halves, around a stand-in for the family's own code."""
    seen = []
    arguments = family(monkeypatch, seen)
    monkeypatch.setenv("DETERMINISTIC", "")
    url = standalone(importlib.import_module(module).load(*arguments))
    _, ours = robosuite()
    (answer,) = ask(url, request_of(name, ours))
    assert not isinstance(answer, RemoteError), answer
    assert Translator(load_mapping(name)).actions(answer).shape == (steps, 7)
    asked = seen[-1]
    if name == "unifolm_vla":
        assert [f["full_image"].shape for f in asked["frames"]] == [(224, 224, 3)] * 2
        assert asked["task"] == "Put the BOWL down"
        assert asked["statistics"] == "actions of libero_goal_no_noops"
    elif name == "being_h05":
        assert next(iter(asked)).startswith("video")  # how Being-H tells that there is a batch axis
        assert asked["state.libero_gripper_position"].shape == (1, 2)
    else:
        assert asked["proprio"].shape == (9,)
        assert asked["task"] == "Put the BOWL down"
