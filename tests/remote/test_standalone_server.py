"""`policies/servers/policy_server.py`: the server for environments that cannot hold LeRobot."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
import websockets.sync.client
from websockets.exceptions import ConnectionClosed

from lerobot_roborecover.policies.remote.errors import ServerRefusedError
from lerobot_roborecover.policies.remote.protocol import pack, unpack
from tests.support.policy_servers import ask, openpi_client, standalone  # noqa: F401 - fixtures
from tests.support.processes import PATIENCE_S

KEY = "sixteen-letters-or-more"


def test_the_standalone_server_speaks_to_both_clients(standalone, openpi_client):  # noqa: F811
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    url = standalone(lambda request: {"actions": request["state"][None] * 2})
    theirs = WebsocketClientPolicy(url)
    assert theirs.get_server_metadata() == {"policy": "p"}
    np.testing.assert_array_equal(theirs.infer({"state": np.ones(3)})["actions"], [[2, 2, 2]])
    with pytest.raises(RuntimeError, match="KeyError") as refused:
        theirs.infer({"stat": 1})
    assert "Traceback (most recent call last)" not in str(refused.value)
    good, bad, objects = ask(url, {"state": np.ones(3)}, {"stat": 1}, {"state": b"\x80"})
    np.testing.assert_array_equal(good["actions"], [[2, 2, 2]])
    assert "KeyError: 'state'" in str(bad)
    assert isinstance(objects, ServerRefusedError)


def test_the_standalone_server_bounds_the_values_of_a_request(standalone, capfd):  # noqa: F811
    import msgpack

    url = standalone(lambda request: {"actions": np.zeros((1, 2)), "said": request.get("text")})
    with websockets.sync.client.connect(url, max_size=None) as client:
        client.recv()
        for message in ([[1] * 4000] * 100, [[{}] * 4000] * 30, [[[1] * 50] * 50] * 50):
            client.send(msgpack.packb(message))
            assert "more than 65536 values" in client.recv()
        client.send(msgpack.packb({"\x1b[2J\x1b[31mtext": {b"__ndarray__": True, b"dtype": "\x1b]0;x\x07"}}))
        assert "are not taken" in client.recv()
        client.send(pack({"text": "a"}))
        assert unpack(client.recv())["said"] == "a"
    assert not set(capfd.readouterr().err) & {"\x1b", "\x07"}


def test_the_standalone_server_takes_so_many_connections(standalone):  # noqa: F811
    module = importlib.import_module("policy_server")
    url = standalone(lambda request: {"actions": np.zeros((1, 2))})
    clients = [websockets.sync.client.connect(url) for _ in range(module.MAX_CONNECTIONS)]
    for client in clients:
        client.recv()
    with websockets.sync.client.connect(url) as late, pytest.raises(ConnectionClosed) as refused:
        late.recv(timeout=PATIENCE_S)
    assert "16 connections" in refused.value.rcvd.reason
    for client in clients:
        client.close()


@pytest.mark.slow
def test_the_standalone_server_keeps_strangers_out(standalone, openpi_client, monkeypatch):  # noqa: F811
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    monkeypatch.setenv("ROBORECOVER_API_KEY", KEY)
    url = standalone(lambda request: {"actions": request["state"][None]})
    for headers in ({}, {"Authorization": "Api-Key x"}, {"Origin": "https://example.org"}):
        with pytest.raises(websockets.exceptions.InvalidStatus):
            websockets.sync.client.connect(url, additional_headers=headers)
    np.testing.assert_array_equal(ask(url, {"state": np.ones(3)}, api_key=KEY)[0]["actions"], [[1, 1, 1]])
    theirs = WebsocketClientPolicy(url, api_key=KEY)
    np.testing.assert_array_equal(theirs.infer({"state": np.ones(3)})["actions"], [[1, 1, 1]])
    module = importlib.import_module("policy_server")
    monkeypatch.setenv("ROBORECOVER_API_KEY", "fifteen-letters")
    with pytest.raises(SystemExit, match="has 15 characters; a server's key has 16 or more"):
        module.serve(lambda request: {})
    monkeypatch.setenv("ROBORECOVER_API_KEY", "")
    with pytest.raises(SystemExit, match="set and empty"):
        module.serve(lambda request: {})
    monkeypatch.delenv("ROBORECOVER_API_KEY")
    with pytest.raises(SystemExit, match="could use the policy"):
        module.serve(lambda request: {}, host="0.0.0.0")
