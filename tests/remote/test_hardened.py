"""What a policy server that faces a network must stand: strangers, web pages, bad frames, other cameras."""

from __future__ import annotations

import os
import ssl
import sys
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgpack
import numpy as np
import pytest
import websockets.sync.client
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.policies.remote.errors import RemoteError, WireError
from lerobot_roborecover.policies.remote.keys import api_key
from lerobot_roborecover.policies.remote.protocol import pack, unpack
from tests.support.policy_servers import OpenpiServer, serving
from tests.support.serve_loop import (  # noqa: F401 - fixtures
    STATE,
    act,
    checkpoints,
    load,
)
from tests.support.tls import certificate

pytestmark = pytest.mark.lerobot
SLACK_BYTES = 64 * 2**20
"""Beside four times a frame's size: room that lists announce before they are read."""


def connect(url, **headers):
    return websockets.sync.client.connect(url, additional_headers=headers)


def status(url, **headers):
    with pytest.raises(InvalidStatus) as refused:
        connect(url, **headers)
    return refused.value.response.status_code


class Cameras:
    """Two pictures, or one: what the policy makes of a picture is its mean."""

    max_batch, horizon, action_width, resumable = 8, 1, 2, False

    def __init__(self):
        self.batches: list[list[tuple[str, ...]]] = []

    def metadata(self, name):
        return {"server": "test"}

    def check(self, content):
        return {k: v for k, v in content.items() if k.startswith("observation.")}

    def batch_key(self, observation):
        from lerobot_roborecover.policies.remote.served import ServedPolicy

        return ServedPolicy.batch_key(self, observation)

    def start(self, seed, step=0):
        return seed

    def finish(self, history):
        pass

    def act(self, observations, instructions, histories):
        self.batches.append([tuple(o) for o in observations])
        keys = observations[0]  # as a batch is made of them: by the first one's keys
        stacked = {k: np.stack([o[k] for o in observations]) for k in keys}
        return [
            np.array([[sum(float(v[i].sum()) for v in stacked.values()), len(keys)]])
            for i in range(len(observations))
        ]


def picture(value, side=4):
    return np.full((side, side, 3), value, np.uint8)


def test_clients_with_other_cameras_or_sizes_are_not_one_batch():
    observations = [
        {"observation.images.a": picture(1)},
        {"observation.images.a": picture(2), "observation.images.b": picture(3)},
        {"observation.images.a": picture(1, side=6)},
        {"observation.images.a": picture(5)},
    ]
    policy = Cameras()
    # The delay is longer than any test may take: only a complete batch is answered.
    with serving(policy, batch_delay_s=600.0) as (url, _), ThreadPoolExecutor(4) as threads:
        clients = [connect(url) for _ in observations]

        def ask(client, observation):
            client.recv()
            client.send(pack(observation))
            return unpack(client.recv())["actions"][0]

        answers = list(threads.map(ask, clients, observations))
        for client in clients:
            client.close()
    expected = [[sum(int(v.sum()) for v in o.values()), len(o)] for o in observations]
    np.testing.assert_array_equal(answers, expected)
    assert sorted(map(len, policy.batches)) == [1, 1, 2]


def test_web_pages_and_other_names_are_refused_on_the_loopback():
    with serving(Cameras()) as (url, _):
        connect(url).close()
        connect(url.replace("127.0.0.1", "localhost")).close()
        assert status(url, Origin="https://example.org") == 403
        assert status(url, Origin="null") == 403
        # A page whose name was made to resolve to 127.0.0.1 says that name.
        host, port = url.removeprefix("ws://").split(":")
        with pytest.raises(InvalidStatus) as refused:
            websockets.sync.client.connect(f"ws://rebound.example:{port}", sock=_socket(host, int(port)))
        assert refused.value.response.status_code == 403


def _socket(host, port):
    import socket

    return socket.create_connection((host, port))


def test_a_key_is_compared_whole_and_once():
    with serving(Cameras(), api_key="secret") as (url, _):
        assert status(url) == 401
        assert status(url, Authorization="Api-Key secre") == 401
        assert status(url, Authorization="Api-Key ") == 401
        with pytest.raises(InvalidStatus) as refused:
            websockets.sync.client.connect(
                url, additional_headers=[("Authorization", "Api-Key secret"), ("Authorization", "Api-Key x")]
            )
        assert refused.value.response.status_code == 401
        connect(url, Authorization="Api-Key secret").close()


@pytest.mark.parametrize(
    ("key", "words"), [("", "set and empty"), ("  ", "set and empty"), ("a\n", "spaces")]
)
def test_an_empty_key_is_an_error_on_both_sides(monkeypatch, key, words):
    monkeypatch.setenv("ROBORECOVER_API_KEY", key)
    with pytest.raises(RemoteError, match=words):
        api_key()


def test_an_open_server_is_asked_for_by_name(checkpoints, capsys, monkeypatch):  # noqa: F811
    monkeypatch.setattr(sys, "argv", ["roborecover"])
    policy = [f"--policy.path={checkpoints['act']}", "--policy.device=cpu"]
    monkeypatch.delenv("ROBORECOVER_API_KEY", raising=False)
    for arguments, words in (
        (["--host=0.0.0.0"], "or say --insecure=true"),
        (["--host=example.org"], "or say --insecure=true"),
        (["--keyfile=key.pem"], "the key of which certificate"),
        (["--certfile=absent.pem", "--port=0"], "--certfile=absent.pem"),
    ):
        assert main(["serve", *policy, *arguments]) == 2
        assert words in capsys.readouterr().err.splitlines()[-1]
    monkeypatch.setenv("ROBORECOVER_API_KEY", "")
    assert main(["serve", *policy]) == 2
    assert "set and empty" in capsys.readouterr().err.splitlines()[-1]


def test_clients_learn_no_path(checkpoints):  # noqa: F811
    from lerobot_roborecover.policies.remote.serve import public_name

    folder = str(checkpoints["act"])
    assert public_name(folder) == Path(folder).name
    assert public_name("org/model") == "org/model"


def test_traffic_over_tls(tmp_path, monkeypatch):
    cert, key = certificate(tmp_path)
    from tests.support.policy_servers import ask as ask_server

    with serving(Cameras(), certfile=cert, keyfile=key) as (url, _):
        secure = url.replace("ws://", "wss://")
        (unknown,) = ask_server(secure, {"observation.images.a": picture(1)})
        assert "certificate" in str(unknown).lower()
        monkeypatch.setenv("SSL_CERT_FILE", cert)
        (answer,) = ask_server(secure, {"observation.images.a": picture(1)})
        assert not isinstance(answer, Exception), answer
        np.testing.assert_array_equal(answer["actions"], [[48, 1]])
        with connect_tls(secure, cert) as client:
            assert unpack(client.recv()) == {"server": "test"}


def connect_tls(url, cert):
    return websockets.sync.client.connect(url, ssl=ssl.create_default_context(cafile=cert))


# --- frames


def nested(levels, fan):
    value = [1] * fan
    for _ in range(levels):
        value = [value] * fan
    return msgpack.packb(value)


@pytest.mark.parametrize(
    "data",
    [
        nested(3, 60),  # 13 million values, in 13 MB
        b"\xdc\x10\x00" * 1000,  # a thousand lists that each announce 4096 values
        b"\xdd\x00\x01\x86\xa0" * 1000,
        msgpack.packb([[{}] * 4000] * 30),
        msgpack.packb("é" * (2 * 2**20)),
    ],
)
def test_small_frames_do_not_become_large_memory(data):
    tracemalloc.start()
    try:
        with pytest.raises(WireError):
            unpack(data)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak <= 4 * len(data) + SLACK_BYTES


@pytest.mark.parametrize("name", [",,,", "f4,f4", "(2,3)f4", "O", "V8", "f16", "M8", "\x00", "a" * 10_000])
def test_whatever_numpy_makes_of_a_dtype_is_a_refusal(name):
    data = {b"__ndarray__": True, b"dtype": name, b"shape": [1], b"data": b"0" * 8}
    with pytest.raises(WireError, match="dtype"):
        unpack(msgpack.packb(data))


_leaves = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=20)
    | st.binary(max_size=40)
)
_keys = st.sampled_from(
    [b"__ndarray__", b"__npgeneric__", b"dtype", b"shape", b"data", "prompt", "roborecover", "reset",
     "observation.state", "observation.environment_state", "observation.image"]
)  # fmt: skip
_dtypes = st.sampled_from(["<f4", "<f8", "|u1", "|b1", ",,,", "O", "float32", "<i8"])
_arrays = st.fixed_dictionaries(
    {
        b"__ndarray__": st.just(True),
        b"dtype": _dtypes | _leaves,
        b"shape": st.lists(st.integers(-1, 8), max_size=5) | _leaves,
        b"data": st.binary(max_size=80) | _leaves,
    }
)
_messages = st.recursive(
    _leaves | _arrays,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(_keys, inner, max_size=6),
    max_leaves=20,
)


def _bent(message, cut, at, byte):
    data = bytearray(msgpack.packb(message))
    if data and at is not None:
        data[at % len(data)] = byte
    return bytes(data[: len(data) - cut % (len(data) + 1)])


FRAMES = st.builds(
    _bent, _messages, st.just(0) | st.integers(0, 50), st.none() | st.integers(0, 10_000), st.integers(0, 255)
)


def fuzz(url, examples):
    """Sends frames, one after the other, and asks something reasonable in between."""

    @settings(
        max_examples=examples, deadline=None, database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )  # fmt: skip
    @given(FRAMES)
    def one(frame):
        with websockets.sync.client.connect(url, max_size=None) as client:
            client.recv()
            client.send(frame)
            answer = client.recv(timeout=120)
            assert isinstance(answer, bytes) or "Traceback" not in answer
            client.send(pack(STATE))
            good = client.recv(timeout=120)
            assert isinstance(good, bytes), good

    one()


def test_strange_frames_are_answered_in_words(act):  # noqa: F811
    fuzz(act[0], examples=60)


@pytest.mark.nightly
def test_strange_frames_for_minutes(act):  # noqa: F811
    """`ROBORECOVER_FUZZ` frames, 10,000 by default: some four minutes of a core; 30,000 take ten."""
    fuzz(act[0], examples=int(os.environ.get("ROBORECOVER_FUZZ", "10000")))


# --- the client


@pytest.mark.parametrize("width", [1, 3, 900])
def test_a_too_wide_action_is_refused_where_it_arrives(width, tmp_path):
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig
    from lerobot_roborecover.policies.remote.modeling_remote import RemotePolicy

    mapping = tmp_path / "mapping.yaml"
    mapping.write_text("version: 1\nabout: a server\nstate: [{key: s, parts: [{slice: [0, 4]}]}]\n")
    server = OpenpiServer(lambda request, connection: {"actions": np.zeros((4, width))})
    with server.running() as url:
        config = RemoteConfig(
            url=url,
            mapping=str(mapping),
            output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        )
        policy = RemotePolicy(config)
        slot = policy.open_slot(1)
        (answer,) = policy.ask([{"observation.state": np.zeros(4, np.float32)}], ["push"], [slot])
        policy.server.close()
    assert isinstance(answer, WireError)
    assert f"width {width}; the environment takes 2" in str(answer)
