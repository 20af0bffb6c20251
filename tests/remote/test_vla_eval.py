"""vla-eval's protocol, against the real package's own server with a small model."""

from __future__ import annotations

import re

import numpy as np
import pytest

from lerobot_roborecover.policies.remote.errors import (
    MappingError,
    RemoteError,
    ServerRefusedError,
    ServerUnavailableError,
    SessionExpiredError,
    WireError,
)
from lerobot_roborecover.policies.remote.mapping import load_mapping, parse_mapping
from lerobot_roborecover.policies.remote.translate import Translator
from lerobot_roborecover.policies.remote.vla_eval import pack_message, unpack_message
from tests.support.policy_servers import vla_eval  # noqa: F401 - a fixture
from tests.support.processes import PATIENCE_S
from tests.support.serve_loop import (  # noqa: F401 - fixtures
    TRIALS,
    dataset,
    evaluate,
    remote,
)
from tests.support.vla_eval_server import model_server

pytestmark = pytest.mark.lerobot

MAPPING = """
version: 1
about: a vla-eval server for the fake simulator
protocol: vla_eval
state: [{key: states, parts: [{slice: [0, 4]}]}]
prompt: {key: task_description}
specs: {action: {position: delta_xy}, observation: {state: xyvv, language: language}}
actions: {execute: 1}
"""


@pytest.fixture
def mapping(tmp_path):
    (tmp_path / "fake.yaml").write_text(MAPPING)
    return str(tmp_path / "fake.yaml")


def policy(url, mapping, width=2, **options):
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig
    from lerobot_roborecover.policies.remote.modeling_remote import RemotePolicy

    settings = {"wait_s": 1, "reconnect_s": 0.3, "timeout_s": PATIENCE_S, **options}
    features = {"action": PolicyFeature(FeatureType.ACTION, (width,))}
    return RemotePolicy(RemoteConfig(url=url, mapping=mapping, output_features=features, **settings))


def state(value):
    return {"observation.state": np.full(4, value, np.float32)}


def test_the_bytes_are_theirs(vla_eval):  # noqa: F811
    from vla_eval.protocol.messages import Message, MessageType
    from vla_eval.protocol.messages import pack_message as theirs
    from vla_eval.protocol.messages import unpack_message as read

    rng = np.random.default_rng(0)
    payload = {
        "images": {"agentview": rng.integers(0, 256, (20, 30, 3), np.uint8)},
        "states": rng.normal(size=8), "task_description": "push", "n": np.float32(2.5),
    }  # fmt: skip
    got = read(pack_message("observation", payload, 7))
    assert (got.type, got.seq) == (MessageType.OBSERVATION, 7)
    np.testing.assert_array_equal(got.payload["images"]["agentview"], payload["images"]["agentview"])
    np.testing.assert_array_equal(got.payload["states"], payload["states"])
    assert got.payload["n"] == 2.5
    action = {"actions": rng.normal(size=7).astype(np.float32)}
    kind, answer, number = unpack_message(theirs(Message(MessageType.ACTION, action, 3)))
    assert (kind, number) == ("action", 3)
    np.testing.assert_array_equal(answer["actions"], action["actions"])


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        ({"actions": {"__ndarray__": True, "dtype": ",,,", "shape": [1], "data": b"1"}}, "dtype"),
        ({"actions": {"__ndarray__": True, "dtype": "O", "shape": [1], "data": b"12345678"}}, "dtype"),
        ({"actions": {"__image__": True, "format": "png", "data": b""}}, "no pictures"),
    ],
)
def test_answers_that_are_refused(payload, words):
    import msgpack

    data = msgpack.packb({"type": "action", "payload": payload, "seq": 1, "timestamp": 0.0})
    with pytest.raises(WireError, match=words):
        unpack_message(data)
    for other in (msgpack.packb([1]), msgpack.packb({"type": 1, "payload": 0, "seq": 0}), b"\xc1", "text"):
        with pytest.raises(WireError):
            unpack_message(other)


def test_every_slot_has_an_episode_of_its_own(vla_eval, mapping):  # noqa: F811
    """A server with a chunk of three keeps it with the connection; slots take turns."""

    def predict(obs):
        return np.full((3, 2), obs["states"][0]) + np.arange(3)[:, None]

    with model_server(predict, chunk=3) as (url, told):
        made = policy(url, mapping, connections=2)
        slots = [made.open_slot(1) for _ in range(3)]  # more than connections to begin with
        for step in range(4):
            observations = [state(10 * k + 100 * step) for k in range(3)]
            answers = made.ask(observations, ["push"] * 3, slots)
            inferred = 0 if step < 3 else 300
            expected = [np.full((1, 2), 10 * k + inferred + step % 3) for k in range(3)]
            for answer, value in zip(answers, expected, strict=True):
                np.testing.assert_array_equal(answer, value)
        for slot in slots:
            made.close_slot(slot)
        slot = made.open_slot(1)
        np.testing.assert_array_equal(made.ask([state(5)], ["pull"], [slot])[0], [[5, 5]])
        made.server.close()
    starts = [config for kind, config in told if kind == "start"]
    assert [s["task"]["name"] for s in starts] == ["push"] * 3 + ["pull"]
    assert sum(kind == "end" for kind, _ in told) >= 3
    assert sum(kind == "observation" for kind, _ in told) == 7


def test_a_chunk_is_pulled_by_repeating_the_observation(vla_eval, mapping):  # noqa: F811
    with model_server(lambda obs: np.arange(6).reshape(3, 2) + obs["states"][0], chunk=3) as (url, told):
        made = policy(url, mapping, n_action_steps=3)
        slot = made.open_slot(1)
        for value in (0, 7):
            answer = made.ask([state(value)], ["push"], [slot])[0]
            np.testing.assert_array_equal(answer, np.arange(6).reshape(3, 2) + value)
        made.server.close()
    assert sum(kind == "observation" for kind, _ in told) == 2, "one inference a chunk"


def test_rows_come_from_a_vla_eval_server(vla_eval, evaluate, mapping):  # noqa: F811
    with model_server(lambda obs: obs["states"][:2] * 0.5) as (url, told):
        rows = evaluate(*remote(url, mapping, protocol="vla_eval", name="p"), slots=2)
        again = evaluate(*remote(url, mapping, name="p"), slots=1, name="again")
    assert len(rows) == 3 * TRIALS
    assert {(r.outcome, r.noise) for r in rows} == {("horizon", "unseeded")}

    def executed(found):
        return {(r.scenario_id, r.trial): r.actions_sha256 for r in found}

    assert executed(rows) == executed(again)
    assert sum(kind == "start" for kind, _ in told) == 2 * len(rows)


def test_what_goes_wrong_is_named(vla_eval, mapping):  # noqa: F811
    kind = ["raises"]

    def predict(obs):
        if kind[0] == "raises":
            raise KeyError("no such camera")
        return {"chunk": np.zeros((4, 2)), "wide": np.zeros(3), "nan": np.full(2, np.nan)}[kind[0]]

    with model_server(predict) as (url, _):
        made = policy(url, mapping)
        for what, error, words in (
            ("raises", ServerRefusedError, "no such camera"),
            ("chunk", WireError, r"shape \(4, 2\); vla-eval gives one action"),
            ("wide", WireError, "width 3; the environment takes 2"),
            ("nan", WireError, "non-finite"),
        ):
            kind[0] = what
            slot = made.open_slot(1)
            (answer,) = made.ask([state(0)], ["push"], [slot])
            assert isinstance(answer, error)
            assert re.search(words, str(answer))
            made.close_slot(slot)
        made.server.close()


def test_a_connection_that_is_lost_takes_its_episode_with_it(vla_eval, mapping):  # noqa: F811
    with model_server(lambda obs: np.zeros(2)) as (url, _):
        made = policy(url, mapping)
        slot = made.open_slot(1)
        assert isinstance(made.ask([state(0)], ["push"], [slot])[0], np.ndarray)
        made.server._pinned[slot.session]._socket.close()
        assert isinstance(made.ask([state(0)], ["push"], [slot])[0], SessionExpiredError)
        fresh = made.open_slot(1)
        assert isinstance(made.ask([state(0)], ["push"], [fresh])[0], np.ndarray)
    (answer,) = made.ask([state(0)], ["push"], [made.open_slot(2)])
    assert isinstance(answer, ServerUnavailableError)
    made.server.close()


@pytest.mark.parametrize(
    ("specs", "words"),
    [
        (({"position": (3, "delta_xyz")}, {}), "width 3, the environment takes 2.*'delta_xyz'"),
        (({"joints": (2, "absolute")}, {}), "no position; they have .'joints'"),
        (({}, {"wrist": (0, "rgb_hwc_uint8")}), "looks at wrist"),
        (({}, {"state": (4, "joint_positions")}), "the mapping gives 'xyvv'"),
        (({"position": (2, "raw")}, {"state": (4, "xyvv"), "language": (0, "language")}), ""),
    ],
)
def test_what_does_not_fit_is_refused_before_a_simulator_starts(vla_eval, mapping, specs, words):  # noqa: F811
    with model_server(lambda obs: np.zeros(2), specs=specs) as (url, _):
        if not words:
            policy(url, mapping).server.close()
            return
        with pytest.raises(MappingError, match=words):
            policy(url, mapping)


def test_the_protocol_is_the_mappings():
    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig
    from lerobot_roborecover.policies.remote.modeling_remote import RemotePolicy

    with pytest.raises(RemoteError, match="not one of openpi, vla_eval"):
        RemoteConfig(protocol="zmq")
    assert RemoteConfig(protocol="vla_eval").mapping == "vla_eval_libero"
    with pytest.raises(MappingError, match="openpi_libero is for openpi"):
        RemotePolicy(RemoteConfig(protocol="vla_eval", mapping="openpi_libero", wait_s=0))
    with pytest.raises(MappingError, match="takes no native"):
        parse_mapping("version: 1\nabout: x\nprotocol: vla_eval\nnative: true", "m.yaml")


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("flags", [set(), {"send_wrist_image"}, {"send_wrist_image", "send_state"},
                                   {"send_state", "quat_no_antipodal"}])  # fmt: skip
def test_libero_is_seen_as_by_their_own_benchmark(vla_eval, sign, flags):  # noqa: F811
    from lerobot.processor.env_processor import LiberoProcessorStep
    from vla_eval.benchmarks.libero.benchmark import LIBEROBenchmark

    rng = np.random.default_rng(3)
    quat = rng.normal(size=4)
    quat *= sign / np.linalg.norm(quat) * np.sign(quat[3])
    raw = {
        "agentview_image": rng.integers(0, 256, (256, 256, 3), np.uint8),
        "robot0_eye_in_hand_image": rng.integers(0, 256, (256, 256, 3), np.uint8),
        "robot0_eef_pos": rng.normal(size=3), "robot0_eef_quat": quat,
        "robot0_gripper_qpos": rng.normal(size=2),
    }  # fmt: skip
    theirs = LIBEROBenchmark(
        send_wrist_image="send_wrist_image" in flags, quat_no_antipodal="quat_no_antipodal" in flags
    )
    wanted = theirs.make_obs(raw, {"name": "Open the Drawer"})
    if "send_state" in flags:
        wanted["states"] = theirs._proprio_state(raw)

    import torch

    axis_angle = LiberoProcessorStep()._quat2axisangle(torch.from_numpy(quat[None]))[0].numpy()
    ours = {
        "observation.images.image": _lerobots(raw["agentview_image"]),
        "observation.images.image2": _lerobots(raw["robot0_eye_in_hand_image"]),
        "observation.state": np.concatenate([raw["robot0_eef_pos"], axis_angle, raw["robot0_gripper_qpos"]]),
    }
    translator = Translator(load_mapping("vla_eval_libero"))
    translator.flags = frozenset(flags)
    found = translator.request([translator.frame(ours)], "Open the Drawer")
    assert set(found) == set(wanted)
    assert found["task_description"] == wanted["task_description"]
    assert set(found["images"]) == set(wanted["images"])
    for name, picture in wanted["images"].items():
        np.testing.assert_array_equal(found["images"][name], picture)
    if "send_state" in flags:
        np.testing.assert_allclose(found["states"], wanted["states"], atol=2e-6)


def _lerobots(picture):
    """LeRobot's: turned by 180 degrees, (3, H, W) from 0 to 1."""
    return np.ascontiguousarray(picture[::-1, ::-1].transpose(2, 0, 1)).astype(np.float32) / 255


def test_the_gripper_is_theirs(vla_eval):  # noqa: F811
    translator = Translator(load_mapping("vla_eval_libero"), width=7)
    for value, expected in ((-0.3, -1), (0.0, 1), (0.2, 1)):
        chunk = np.array([[0, 0, 0, 0, 0, 0, value]], np.float32)
        assert translator.actions({"actions": chunk})[0, -1] == expected
