"""GR00T's protocol, against a server written from its source."""

from __future__ import annotations

import io
from contextlib import suppress

import msgpack
import numpy as np
import pytest

pytest.importorskip("zmq", reason="pyzmq: install the gr00t extra")

from lerobot_roborecover.policies.remote.errors import (
    MappingError,
    RemoteError,
    ServerRefusedError,
    ServerUnavailableError,
    WireError,
)
from lerobot_roborecover.policies.remote.gr00t import pack_call, read_npy, unpack_answer
from lerobot_roborecover.policies.remote.mapping import load_mapping, parse_mapping
from lerobot_roborecover.policies.remote.translate import Translator
from tests.support.gr00t_server import Gr00tServer, dumps, modalities
from tests.support.processes import PATIENCE_S
from tests.support.serve_loop import TRIALS, dataset, evaluate, remote  # noqa: F401 - fixtures

pytestmark = pytest.mark.lerobot

HEAD = "version: 1\nabout: a GR00T server for the fake simulator\nprotocol: gr00t\n"
FLAT = (
    HEAD
    + """
state: [{key: state.puck, parts: [{slice: [0, 4]}], batch_axis: true, time_axis: true}]
prompt: {key: annotation.task, as_list: true}
actions: {joined: {keys: [action.x, action.y], columns: [0, 1]}, execute: 3}
"""
)
NESTED = (
    HEAD
    + """
state: [{under: state, key: puck, parts: [{slice: [0, 4]}], batch_axis: true, time_axis: true}]
window: {frames: 2}
prompt: {under: language, key: task, as_list: true, batch_axis: true}
reset: {message: {options: null}}
actions: {joined: {keys: [x, y], columns: [1, 0]}}
"""
)
N15 = (
    HEAD
    + """
argument: ""
state: [{key: state.puck, parts: [{slice: [0, 4]}], time_axis: true}]
prompt: {key: annotation.task, as_list: true}
actions: {joined: {keys: [action.x, action.y], columns: [0, 1]}}
"""
)
FITS = modalities(
    state=(["puck"], [0]), action=(["x", "y"], list(range(4))), language=(["annotation.task"], [0])
)


def chunk(value, names=("action.x", "action.y"), length=4):
    """(1, n, 1) a key: value, value + 1, ... and their negatives."""
    row = value + np.arange(length, dtype=np.float32)[None, :, None]
    return {names[0]: row, names[1]: -row}


@pytest.fixture
def mapping(tmp_path):
    def write(text=FLAT):
        (tmp_path / "fake.yaml").write_text(text)
        return str(tmp_path / "fake.yaml")

    return write


def policy(url, mapping, width=2, **options):
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig
    from lerobot_roborecover.policies.remote.modeling_remote import RemotePolicy

    settings = {"wait_s": 2, "reconnect_s": 0.3, "timeout_s": PATIENCE_S, "connections": 2, **options}
    features = {"action": PolicyFeature(FeatureType.ACTION, (width,))}
    return RemotePolicy(RemoteConfig(url=url, mapping=mapping, output_features=features, **settings))


def state(value):
    return {"observation.state": np.full(4, value, np.float32)}


def ask(made, value=0.0, task="push"):
    (answer,) = made.ask([state(value)], [task], [made.open_slot(1)])
    return answer


# --- bytes


def test_arrays_travel_as_npy_files():
    rng = np.random.default_rng(0)
    observation = {"video.a": rng.integers(0, 256, (1, 1, 5, 7, 3), np.uint8), "n": np.float32(2.5)}
    call = msgpack.unpackb(pack_call("get_action", {"observation": observation}, "key"))
    assert (call["endpoint"], call["api_token"]) == ("get_action", "key")
    sent = call["data"]["observation"]["video.a"]
    assert sent["__ndarray_class__"] is True
    np.testing.assert_array_equal(
        np.load(io.BytesIO(sent["as_npy"]), allow_pickle=False), observation["video.a"]
    )
    assert call["data"]["observation"]["n"] == 2.5
    assert "data" not in msgpack.unpackb(pack_call("ping"))
    for value in (
        rng.normal(size=(2, 3)),
        np.asfortranarray(rng.normal(size=(2, 3))),
        np.zeros((0, 4), "<f4"),
    ):
        got = unpack_answer(dumps([{"x": value}, {}]))[0]["x"]
        np.testing.assert_array_equal(got, value)
        assert not got.flags.writeable
    with pytest.raises(WireError, match="dtype object"):
        pack_call("get_action", {"observation": np.array([{}])})
    with pytest.raises(WireError, match="a set is not sent"):
        pack_call("get_action", {"observation": {1}})


def npy(header, data=b""):
    text = header.encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,)}\n"), "0 bytes of data"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-1,)}\n"), "shape"),
        (npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}\n", b"12345678"), "dtype"),
        (npy("{'descr': ',,,', 'fortran_order': False, 'shape': (1,)}\n", b"1"), "msgpack: "),
        (npy("{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,)}\n", b"1234"), "dtype"),
        (npy("(" * 600 + "\n"), "msgpack: "),
        (npy(" " * 2000), "2000 characters"),
        (b"PK\x03\x04" + b"\0" * 40, "magic"),
        (b"\x93NUMPY\x03\x00" + b"\0" * 40, "version"),
        (b"", "magic"),
        ("text", "str data"),
    ],
)
def test_arrays_that_are_refused(data, words):
    with pytest.raises(WireError, match=words):
        unpack_answer(msgpack.packb({"x": {"__ndarray_class__": True, "as_npy": data}}))


def test_answers_that_are_refused():
    for data, error in (
        (b"ERROR", ServerRefusedError),
        (b"\xc1", WireError),
        (dumps({"error": "out of memory"}), ServerRefusedError),
        (msgpack.packb([[0] * 4000] * 20), WireError),
    ):
        with pytest.raises(error):
            unpack_answer(data)
    good = io.BytesIO()
    np.save(good, np.eye(2))
    np.testing.assert_array_equal(read_npy(good.getvalue()), np.eye(2))


@pytest.mark.filterwarnings("ignore")
def test_broken_answers_are_refused_in_words():
    rng = np.random.default_rng(7)
    good = np.frombuffer(dumps([chunk(1.0), {}]), np.uint8)
    for _ in range(500):
        broken = good.copy()
        places = rng.integers(0, len(good), 3)
        broken[places] = rng.integers(0, 256, 3)
        with suppress(RemoteError):
            unpack_answer(broken[: rng.integers(1, len(good) + 1)].tobytes())


# --- servers


def test_observations_have_batch_and_time_axes_and_chunks_come_back(mapping):
    server = Gr00tServer(lambda obs: chunk(obs["state.puck"][0, 0, 0]), FITS)
    with server.running() as url:
        made = policy(url, mapping())
        np.testing.assert_array_equal(ask(made, 5), [[5, -5], [6, -6], [7, -7]])
        made.server.close()
    endpoint, data = server.calls[-1]
    assert endpoint == "get_action"
    assert data["observation"]["state.puck"].shape == (1, 1, 4)
    assert data["observation"]["state.puck"].dtype == np.float32
    assert data["observation"]["annotation.task"] == ["push"]


def test_nested_observations_of_two_steps(mapping):
    declared = modalities(state=(["puck"], [-1, 0]), language=(["task"], [0]), action=(["x", "y"], [0]))
    server = Gr00tServer(lambda obs: chunk(obs["state"]["puck"][0, -1, 0], "xy", 1), declared)
    with server.running() as url:
        made = policy(url, mapping(NESTED), n_action_steps=1)
        slot = made.open_slot(1)
        for value in (1, 2):
            (action,) = made.advance([state(value)], ["push"], [slot])
            np.testing.assert_array_equal(action, [-value, value])
        made.server.close()
    assert [e for e, _ in server.calls] == [
        "ping",
        "get_modality_config",
        "reset",
        "get_action",
        "get_action",
    ]
    puck = [d["observation"]["state"]["puck"][0, :, 0].tolist() for e, d in server.calls if e == "get_action"]
    assert puck == [[1, 1], [1, 2]]
    assert server.calls[-1][1]["observation"]["language"] == {"task": [["push"]]}


def test_n15s_server_takes_the_observation_alone_and_gives_flat_columns(mapping):
    server = Gr00tServer(
        lambda obs: {"action.x": np.arange(3.0) + obs["state.puck"][0, 0], "action.y": np.zeros((3, 1))},
        whole=True,
    )
    with server.running() as url:
        made = policy(url, mapping(N15))
        np.testing.assert_array_equal(ask(made, 4), [[4, 0], [5, 0], [6, 0]])
        made.server.close()
    assert server.calls[-1][1]["state.puck"].shape == (1, 4)


def test_rows_come_from_a_gr00t_server(evaluate, mapping):
    server = Gr00tServer(lambda obs: chunk(0.1 * obs["state.puck"][0, 0, 0]), FITS)
    with server.running() as url:
        rows = evaluate(*remote(url, mapping(), protocol="gr00t", name="p"), slots=2)
    assert len(rows) == 3 * TRIALS
    assert {(r.outcome, r.noise) for r in rows} == {("horizon", "unseeded")}


def test_a_token_is_asked_for(mapping, monkeypatch):
    monkeypatch.delenv("ROBORECOVER_API_KEY", raising=False)
    server = Gr00tServer(lambda obs: chunk(1.0), FITS, token="secret")
    with server.running() as url:
        with pytest.raises(RemoteError, match=r"Unauthorized.*ROBORECOVER_API_KEY"):
            policy(url, mapping())
        monkeypatch.setenv("ROBORECOVER_API_KEY", "secret")
        made = policy(url, mapping())
        assert ask(made).shape == (3, 2)
        made.server.close()


def test_what_goes_wrong_is_named(mapping):
    kind: list = [None]

    def infer(obs):
        if kind[0] == "raises":
            raise KeyError("no such camera")
        return {
            "short": chunk(0.0, length=2), "nan": chunk(np.nan), "text": {"action.x": "left"},
            "wide": {"action.x": np.zeros((1, 4, 1)), "action.y": np.zeros((1, 3, 1))},
            "lacks": {"action.x": np.zeros((1, 4, 1))}, "none": b"\x90", "other": b"ERROR",
        }[kind[0]]  # fmt: skip

    with Gr00tServer(infer, FITS).running() as url:
        made = policy(url, mapping())
        for what, error, words in (
            ("raises", ServerRefusedError, "no such camera"),
            ("short", WireError, "2 actions, fewer than the 3"),
            ("wide", WireError, "shapes"), ("nan", WireError, "non-finite"), ("lacks", WireError, "action.y"),
            ("text", WireError, "str, not an array"), ("none", WireError, "a list, not a map"),
            ("other", ServerRefusedError, "no policy server"),
        ):  # fmt: skip
            kind[0] = what
            answer = ask(made)
            assert isinstance(answer, error), (what, answer)
            assert words in str(answer)
        made.server.close()


def test_a_lost_server_is_away_and_one_that_comes_back_is_used(mapping):
    ends = []

    def infer(obs):
        if not ends:
            ends.append(True)
            return None  # the process ends in the middle of a question
        return chunk(1.0)

    server = Gr00tServer(infer, FITS)
    with server.running() as url:
        made = policy(url, mapping(), reconnect_s=0.2)
        answer = ask(made)
        assert isinstance(answer, ServerUnavailableError)
        assert "no policy server at" in str(answer)
    with server.running(url):
        made.server.options.__dict__["reconnect_s"] = 5.0
        assert ask(made).shape == (3, 2)
    made.server.close()


def test_silence_and_answers_too_large_are_named(mapping):
    with Gr00tServer(lambda obs: {"action.x": np.zeros((1, 2**19, 1))}, FITS).running() as url:
        made = policy(url, mapping(), max_frame_mb=1)
        assert "more than 1 MB (--policy.max_frame_mb)" in str(ask(made))
        made.server.close()
    with pytest.raises(ServerUnavailableError, match=r"no policy server at tcp://127.0.0.1:9 within 0.1 s"):
        policy("tcp://127.0.0.1:9", mapping(), wait_s=0.1)


@pytest.mark.parametrize(
    ("declared", "words"),
    [
        (modalities(video=(["front"], [0])), "looks at video.front; the mapping gives .."),
        (modalities(state=(["arm"], [0])), "looks at state.arm; the mapping gives .'state.puck'."),
        (modalities(state=(["puck"], [-1, 0])), r"steps \[-1, 0\] of state.puck; the mapping gives \[0\]"),
        (modalities(action=(["x"], [0, 1, 2])), "no .'action.y'.; they have .'x'."),
        (modalities(action=(["x", "y"], [0])), "gives 1 actions; 3 are executed"),
        (modalities(language=(["task"], [0])), "instruction at 'task'; the mapping gives it at 'anno"),
        ({"state": {"__ModalityConfig_class__": True,
                    "as_json": '{"delta_indices": [0], "modality_keys": ["q"]}'}}, "looks at state.q"),
        (FITS, ""), (None, ""), ({"state": 3, "video": {"modality_keys": "all"}}, ""),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_before_a_simulator_starts(mapping, declared, words):
    with Gr00tServer(lambda obs: chunk(0.0), declared).running() as url:
        if not words:
            policy(url, mapping()).server.close()
            return
        with pytest.raises(MappingError, match=words):
            policy(url, mapping())


def test_the_protocol_names_the_mapping_and_the_address(mapping):
    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig

    config = RemoteConfig(protocol="gr00t")
    assert (config.mapping, config.url) == ("gr00t_libero", "tcp://127.0.0.1:5555")
    with pytest.raises(RemoteError, match="write tcp://HOST:PORT"):
        RemoteConfig(protocol="gr00t", url="ws://here:1")
    with pytest.raises(MappingError, match=r"is for gr00t.*write tcp://HOST:PORT"):
        policy("ws://127.0.0.1:9", mapping())
    with pytest.raises(MappingError, match="window: give its key"):
        parse_mapping(FLAT + "window: {frames: 2, key: list}\n", "m.yaml")
    with pytest.raises(MappingError, match="takes no native"):
        parse_mapping(HEAD + "native: true\n", "m.yaml")


def test_libero_is_seen_as_by_their_own_client():
    rng = np.random.default_rng(0)
    raw = {name: rng.integers(0, 256, (256, 256, 3), np.uint8) for name in ("image", "image2")}
    numbers = rng.normal(size=8).astype(np.float32)
    ours = {
        f"observation.images.{k}": np.float32(v[::-1, ::-1].transpose(2, 0, 1)) / np.float32(255)
        for k, v in raw.items()
    }
    translator = Translator(load_mapping("gr00t_libero"), width=7)
    frame = translator.frame({**ours, "observation.state": numbers})
    found = translator.request([frame], "put the bowl on the stove")
    np.testing.assert_array_equal(found["video.image"], raw["image"][None, None, ::-1, ::-1])
    np.testing.assert_array_equal(found["video.wrist_image"], raw["image2"][None, None, ::-1, ::-1])
    for i, name in enumerate(("x", "y", "z", "roll", "pitch", "yaw")):
        np.testing.assert_array_equal(found[f"state.{name}"], numbers[None, None, i : i + 1])
    np.testing.assert_array_equal(found["state.gripper"], numbers[None, None, 6:8])
    assert found["annotation.human.action.task_description"] == ["put the bowl on the stove"]
    names = [f"action.{n}" for n in ("x", "y", "z", "roll", "pitch", "yaw", "gripper")]
    answer = {name: np.full((1, 16, 1), 0.1 * i, np.float32) for i, name in enumerate(names)}
    executed = translator.actions(answer)
    assert executed.shape == (8, 7)
    np.testing.assert_allclose(executed[0], [0, 0.1, 0.2, 0.3, 0.4, 0.5, -1], atol=1e-7)
