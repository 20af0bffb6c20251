"""Protocol, mapping files and connections of remote policies, against the real openpi client and bad
servers."""

from __future__ import annotations

import pickle
import re
import socket
import threading
from contextlib import suppress
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.policies.remote.connection import Request
from lerobot_roborecover.policies.remote.errors import (
    MappingError,
    ServerRefusedError,
    ServerUnavailableError,
    WireError,
)
from lerobot_roborecover.policies.remote.mapping import load_mapping, packaged_mappings, parse_mapping
from lerobot_roborecover.policies.remote.protocol import pack, unpack
from tests.support.policy_servers import OpenpiServer, ask, openpi_client, server_at  # noqa: F401 - a fixture
from tests.support.processes import PATIENCE_S

ARRAYS = {
    "image": np.arange(24, dtype=np.uint8).reshape(2, 4, 3),
    "state": np.array([0.1, -2.0, 3e-300]),
    "mask": np.array([True, False]),
    "empty": np.zeros((0, 7), np.float32),
    "scalar": np.float32(1.5),
    "big_endian": np.array([1, 2], ">i4"),
}


# --- protocol


def same(one, two):
    assert set(one) == set(two)
    for key, value in one.items():
        np.testing.assert_array_equal(value, two[key])
        assert np.asarray(value).dtype == np.asarray(two[key]).dtype
        assert np.shape(value) == np.shape(two[key])


def test_the_bytes_are_openpis(openpi_client):  # noqa: F811
    from openpi_client import msgpack_numpy

    message = {**ARRAYS, "prompt": "pick", "nested": {"n": 1}}
    assert pack(message) == msgpack_numpy.packb(message)
    same(unpack(msgpack_numpy.packb(ARRAYS)), ARRAYS)
    same(msgpack_numpy.unpackb(pack(ARRAYS)), ARRAYS)


def array(dtype, shape, data):
    return msgpack.packb({b"__ndarray__": True, b"dtype": dtype, b"shape": shape, b"data": data})


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (array("|O", [1], b"12345678"), "dtype"),
        (array("|V4", [1], b"1234"), "dtype"),
        (array([["a", "|O"]], [1], b"12345678"), "dtype"),
        (array("<f4", [3], b"1234"), "4 bytes of data"),
        (array("<f4", [2**40], b"1234"), "bytes of data"),
        (array("<f4", [-1], b"1234"), "shape"),
        (array("<f4", 1, b"1234"), "shape"),
        (array("<f4", [1], "text"), "str data"),
        (msgpack.packb({b"__npgeneric__": True, b"dtype": "|O", b"data": 1}), "dtype"),
        (pickle.dumps({"a": 1}), "not openpi's msgpack"),
        (b"\x91" * 5000, "not openpi's msgpack"),
        (pack(ARRAYS)[:-3], "not openpi's msgpack"),
        (b"", "not openpi's msgpack"),
        (msgpack.packb([0] * 200_000), "not openpi's msgpack"),
        (msgpack.packb(msgpack.ExtType(5, b"x")), "not openpi's msgpack"),
    ],
)
def test_bytes_that_are_refused(data, words):
    with pytest.raises(WireError, match=words):
        unpack(data, "the server's answer")


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=60) | st.builds(lambda n: pack(ARRAYS)[:n], st.integers(0, 300)))
def test_no_bytes_raise_anything_else(data):
    with suppress(WireError):
        unpack(data)


@pytest.mark.parametrize("value", [np.array([object()]), np.array([1j]), {1, 2}, 2**70, object()])
def test_values_that_are_not_sent(value):
    with pytest.raises(WireError, match="cannot be sent"):
        pack({"a": value})


# --- mappings

HEAD = "version: 1\nabout: a server\n"
STATE = HEAD + "state: [{key: s, parts: [{slice: [0, 3]}]}]\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[1, 2]", "a YAML map, not list"),
        ("a: [", "not YAML"),
        ("about: x", "version"),
        ("version: 9\nabout: x\nnative: true", "reads version 1"),
        (HEAD, "sends nothing"),
        (HEAD + "native: true\nconstants: {a: 1}", "native: true takes no"),
        (HEAD + "state: [{key: s, parts: []}]", "no parts"),
        (HEAD + "state: [{key: s, parts: [{slice: [3, 1]}]}]", "slice"),
        (
            HEAD + "state: [{key: s, parts: [{slice: [0, 4], convert: axis_angle_to_quat_xyzw}]}]",
            "three numbers",
        ),
        (HEAD + "state: [{key: s, parts: [{slize: [0, 3]}]}]", "state.0.parts.0.*slize"),
        (HEAD + "images: [{source: a, key: b, flip: up}]", "images.0.flip.*rotate_180"),
        (HEAD + "images: [{source: a, key: prompt}]", "given twice.*prompt"),
        (STATE + "actions: {execute: 0}", "execute=0"),
        (STATE + "actions: {columns: [0, 1], scale: [1.0]}", "different lengths"),
        (STATE + "actions: {joined: {keys: [a, b], columns: []}}", "joined: needs keys, and columns"),
        (STATE + "window: {frames: 0, key: w}", "frames=0"),
    ],
)
def test_mappings_that_are_refused(text, words):
    with pytest.raises(MappingError, match=f"m.yaml.*{words}"):
        parse_mapping(text, "m.yaml")


def test_the_examples_of_the_docs_are_mappings():
    page = (Path(__file__).parents[2] / "docs" / "servers.md").read_text()
    small, example = re.findall(r"```yaml\n(version.*?)```", page, re.DOTALL)
    assert parse_mapping(small, "docs/servers.md").state[0].key == "state"
    assert parse_mapping(example, "docs/servers.md").window.frames == 2


def test_a_mapping_is_found_by_name_or_path(tmp_path):
    (tmp_path / "mine.yaml").write_text(STATE)
    assert load_mapping(str(tmp_path / "mine.yaml")).about == "a server"
    with pytest.raises(MappingError, match="no such file"):
        load_mapping(str(tmp_path / "other.yaml"))
    with pytest.raises(MappingError, match=r"openpy.*openpi_libero"):
        load_mapping("openpy")
    assert packaged_mappings() == [
        "being_h05", "cosmos_policy", "gr00t_libero", "lerobot", "lingbot_vla", "openpi_libero",
        "unifolm_vla", "vla_eval_libero",
    ]  # fmt: skip


# --- connections


def bad_server(kind):
    """An `infer` that goes wrong at the second request, and its words."""
    count = [0]

    def infer(request, connection):
        count[0] += 1
        if kind == "hangs":
            threading.Event().wait(1.0)
        if kind == "closes":
            connection.close()
        return {
            "enormous": b"\0" * (3 * 2**20), "pickle": pickle.dumps([1]), "garbage": b"\xc1\xff",
            "objects": array("|O", [1], b"12345678"), "words": "Traceback:\n  ...\nKeyError: 'state'\n",
        }.get(kind, {})  # fmt: skip

    return infer


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "error", "words"),
    [
        ("hangs", ServerUnavailableError, "no answer within 0.2 s"),
        ("closes", ServerUnavailableError, "closed the connection 3 times"),
        ("enormous", WireError, "larger than 1 MB"),
        ("pickle", WireError, "not openpi's msgpack"),
        ("garbage", WireError, "not openpi's msgpack"),
        ("objects", WireError, "dtype '|O'"),
        ("words", ServerRefusedError, "KeyError: 'state'$"),
    ],
)
def test_bad_answers(kind, error, words):
    limit = {"timeout_s": 0.2, "wait_s": PATIENCE_S} if kind == "hangs" else {}
    with OpenpiServer(bad_server(kind)).running() as url:
        (answer,) = ask(url, {"a": 1}, **limit, max_frame_bytes=2**20)
    assert isinstance(answer, error)
    assert words.removesuffix("$") in str(answer)
    assert not words.endswith("$") or str(answer).endswith(words[:-1])


@pytest.mark.parametrize(
    ("metadata", "error", "words"),
    [
        ("no room", ServerRefusedError, "first message is an error: no room"),
        (pack([1]), WireError, "metadata is a list"),
        (b"\xc1", WireError, "not openpi's msgpack"),
        (b"\0" * (2 * 2**20), WireError, "larger than 1 MB"),
    ],
)
def test_bad_introductions(metadata, error, words):
    with OpenpiServer(lambda r, c: {}, metadata).running() as url:
        server = server_at(url, max_frame_bytes=2**20)
        with pytest.raises(error, match=words):
            server.reach()
        server.close()


def test_no_server_and_another_server():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"ws://127.0.0.1:{free.getsockname()[1]}"
    (answer,) = ask(url, {})
    assert isinstance(answer, ServerUnavailableError)
    assert f"no policy server at {url}" in str(answer)
    with OpenpiServer(lambda r, c: {}).running() as url:
        (answer,) = ask(url.replace("ws://", "http://"), {})
        assert "write ws://" in str(answer)


@pytest.mark.slow
def test_an_error_costs_its_request_alone_and_a_lost_connection_none():
    """openpi's server closes the connection after a traceback."""

    def infer(request, connection):
        if request["n"] == 1:
            raise KeyError("observation/state")
        if request["n"] == 2 and len(fake.requests) == 3:
            connection.close()  # once: the request is sent again
        return {"n": request["n"]}

    fake = OpenpiServer(infer)
    with fake.running() as url:
        server = server_at(url, connections=1)
        answers = [server.ask([Request({"n": n})])[0] for n in range(4)]
        server.close()
    assert [a["n"] for a in (answers[0], *answers[2:])] == [0, 2, 3]
    assert "KeyError: 'observation/state'" in str(answers[1])
    assert fake.connections == 3


def test_requests_travel_at_once():
    together = threading.Barrier(4, timeout=PATIENCE_S)

    def infer(request, connection):
        together.wait()  # no answer before all four have come
        return {"n": request["n"]}

    with OpenpiServer(infer).running() as url:
        answers = ask(url, *({"n": n} for n in range(4)), connections=4)
    assert [a["n"] for a in answers] == [0, 1, 2, 3]


def test_a_reset_comes_first_on_every_connection():
    fake = OpenpiServer(lambda r, c: {"action": None} if "reset" in r else {"ok": True})
    greeting = {"reset": True, "robo_name": "aloha-agilex"}
    with fake.running() as url:
        server = server_at(url, connections=1, greeting=greeting)
        assert server.ask([Request({"a": 1}, prelude=greeting)]) == [{"ok": True}]
        server.close()
    assert fake.requests == [greeting, greeting, {"a": 1}]
