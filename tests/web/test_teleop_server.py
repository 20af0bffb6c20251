"""The server of teleoperation: what the page is shown, and nothing sent breaks it."""

from __future__ import annotations

import json
import threading
import time

import httpx
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from lerobot_roborecover.platforms.fake.simulator import FakeSimulator
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.web.serve import MAX_SOCKET_MESSAGE_BYTES, make_server
from lerobot_roborecover.web.teleop.client import Client, TeleopRefusal
from lerobot_roborecover.web.teleop.pilot import most_unseen
from lerobot_roborecover.web.teleop.starts import first_state
from tests.support.processes import PATIENCE_S
from tests.support.teleop_sessions import TOKEN, cockpit


class Eyes:
    """A page's connection, message by message."""

    def __init__(self, address):
        self.socket = connect(socket_address(address), proxy=None)
        self.status, self.pictures = {}, []

    def read(self, until, seen=True):
        """Takes messages until a status fits or a picture comes; says that pictures were shown."""
        while True:
            said = self.socket.recv(timeout=PATIENCE_S)
            if isinstance(said, bytes):
                self.pictures.append(said)
                continue
            message = json.loads(said)
            if message["type"] == "shown" and seen:
                self.say("seen")
            if message["type"] == "status":
                self.status = message
            if until(message):
                return message

    def say(self, kind, **values):
        self.socket.send(json.dumps({"type": kind, **values}))


@pytest.mark.slow
def test_a_start_is_shown_before_it_begins_and_comes_again_when_discarded(tmp_path, monkeypatch):
    starts = [first_state("fake", "push-left", seed=s) for s in (3, 4)]
    # The first start takes as long to load as the page takes to come.
    seen, reset = threading.Event(), FakeSimulator.reset

    def slow(simulator, *start):
        assert seen.wait(PATIENCE_S)
        reset(simulator, *start)

    monkeypatch.setattr(FakeSimulator, "reset", slow)
    with cockpit(tmp_path / "r", starts) as found:
        eyes = Eyes(found)
        loading = eyes.read(lambda m: m.get("phase") == "loading")
        seen.set()
        assert loading["instruction"] == starts[0].task.instruction
        assert not eyes.read(lambda m: m.get("phase") == "preview")["under_way"]
        assert eyes.read(lambda m: m["type"] == "shown")["scene"] == eyes.status["scene"]
        for kind in ("mark", "act", "back", "gripper", "finish"):
            eyes.say(kind, id=1)
            assert "only shown yet" in eyes.read(lambda m: m["type"] == "reply")["message"]
        eyes.say("start", number=0)
        assert eyes.read(lambda m: m.get("under_way"))["number"] == 0
        eyes.say("act", actions=[[0.5, 0.5]])
        eyes.say("discard")
        assert eyes.read(lambda m: m.get("phase") == "preview")["number"] == 0
        eyes.say("preview", number=1)
        shown = eyes.read(lambda m: m.get("phase") == "preview" and m["number"] == 1)
        assert shown["label"] == starts[1].label
        # A picture says which start it is of: the last one's is not taken for this one's.
        eyes.read(lambda m: m["type"] == "shown" and m["scene"] == shown["scene"])
        eyes.say("start", number=1)
        eyes.say("act", actions=[[0.5, 0.5]])
        eyes.say("finish", as_dropped=True)
        assert eyes.read(lambda m: m.get("saved") == 1 and m.get("phase") == "idle")["number"] is None
        eyes.socket.close()
    # A later session goes on with what is not saved yet.
    with cockpit(tmp_path / "r", starts) as found:
        eyes = Eyes(found)
        assert eyes.read(lambda m: m.get("phase") == "preview")["number"] == 0
        eyes.socket.close()


@pytest.mark.slow
def test_nobody_drives_blind(tmp_path):
    """Steps wait for pictures that the controller has not shown yet, whatever others have."""
    with cockpit(tmp_path / "r", [first_state("fake", "push-left", seed=3)]) as found:
        eyes = Eyes(found)
        eyes.read(lambda m: m.get("phase") == "preview")
        eyes.read(lambda m: m["type"] == "shown")
        eyes.say("start", number=0)
        eyes.read(lambda m: m.get("under_way"))
        eyes.say("realtime", on=True)
        eyes.read(lambda m: m["type"] == "shown", seen=False)  # and is never said to be seen
        held = eyes.status["step"]
        watcher = Eyes(found)
        watcher.read(lambda m: m["type"] == "status")
        assert watcher.status["role"] == "watch"
        watcher.read(lambda m: m["type"] == "shown")
        time.sleep(0.8)
        eyes.say("status", id=9)
        step = eyes.read(lambda m: m.get("id") == 9)["status"]["step"]
        assert step <= held + most_unseen(20.0, 15.0)
        eyes.say("seen")
        eyes.read(lambda m: m.get("step", 0) > step)
        for each in (eyes, watcher):
            each.socket.close()


def socket_address(address: str, query: str = f"?token={TOKEN}") -> str:
    return address.replace("http://", "ws://").split("?")[0] + "socket" + query


def test_a_server_is_imported_before_its_thread_starts():
    """Two threads that import websockets at once can wait for each other."""
    assert make_server(lambda: None).config.loaded


def test_only_the_page_with_the_token_gets_in(address):
    base, host = address.split("?")[0], address.split("/")[2]
    with httpx.Client(trust_env=False) as client:
        assert client.get(base).status_code == 403
        assert client.get(f"{base}?token={'x' * 32}").status_code == 403
        assert client.get(address, headers={"Host": "evil.example"}).status_code == 421
        answer = client.get(address)
        assert answer.status_code == 303
        assert "httponly" in answer.headers["set-cookie"].lower()
        assert client.get(base).status_code == 200
        for path in ("..%2fpilot.py", "pilot.py", "%2e%2e/server.py", "app.js/"):
            assert client.get(base + path).status_code == 404
        cookie = answer.headers["set-cookie"].split(";")[0]
    plain, keyed = socket_address(address, ""), socket_address(address)
    refused = (
        (plain, {}),
        (socket_address(address, "?token=wrong"), {}),
        (keyed, {"Origin": "http://evil.example"}),
        (keyed, {"Origin": "null"}),
        (plain, {"Cookie": cookie, "Origin": f"http://{host}0"}),
        (keyed.replace("127.0.0.1", "localhost"), {}),
    )
    for url, headers in refused:
        with pytest.raises(InvalidStatus), connect(url, additional_headers=headers, proxy=None):
            pass
    own = {"Cookie": cookie, "Origin": f"http://{host}"}
    with connect(plain, additional_headers=own, proxy=None) as good:
        assert json.loads(good.recv())["type"] == "hello"


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        ("no json", "not JSON"),
        ("[1]", "not a JSON object"),
        ("[" * 30_000, "not JSON"),
        (b"\x00\x01", "are text"),
        ('{"type": "shutdown"}', "'shutdown' is not one of start"),
        ('{"type": 3}', "with a type"),
        ('{"type": "hold"}', "axes must be 6 finite numbers"),
        ('{"type": "hold", "axes": [0, 0, 0, 0, 0, NaN]}', "axes must be 6"),
        ('{"type": "hold", "axes": [0, 0, 0, 0, 0, 1.5]}', "from -1 to 1"),
        ('{"type": "hold", "axes": [true, 0, 0, 0, 0, 0]}', "axes must be 6"),
        (f'{{"type": "hold", "axes": [0, 0, 0, 0, 0, 1{"0" * 400}]}}', "from -1 to 1"),
        (f'{{"type": "act", "actions": [[0, -1{"0" * 400}]]}}', "a list of 2 numbers"),
        (f'{{"type": "back", "steps": 1{"0" * 400}}}', "from 1 to"),
        ('{"type": "act"}', "a list of 1 to 256"),
        ('{"type": "act", "actions": [[0, 0, 0]]}', "2 numbers"),
        ('{"type": "act", "actions": [[0, 0], [0, 1.01]]}', "value 1 is 1.01"),
        ('{"type": "act", "actions": [[Infinity, 0]]}', "value 0 is inf"),
        ('{"type": "act", "actions": [["x", 0]]}', "a list of 2 numbers"),
        ('{"type": "act", "actions": [[1e400, {}]]}', "a list of 2 numbers"),
        ('{"type": "back", "steps": -4}', "from 1 to"),
        ('{"type": "back", "steps": 1.5}', "whole number"),
        ('{"type": "start", "number": 0}', "lists no starts"),
        ('{"type": "start", "task": "push-left", "seed": -1}', "seed must be"),
        ('{"type": "start", "task": 7}', "task must be text"),
        ('{"type": "mark", "stage": ["a"]}', "stage must be text"),
        ('{"type": "gripper"}', "no gripper"),
        ('{"type": "hand_back"}', "no trial waits"),
        ('{"type": "status", "id": "x"}', "id must be"),
    ],
)
def test_a_bad_message_is_refused_in_words_and_nothing_else_happens(address, sent, why):
    with Client(address) as client:
        client.start("push-left", seed=3, discard=True)
        client.act([0.5, 0.5])
        client._socket.send(sent)
        while (said := json.loads(client._receive()))["type"] != "reply":
            pass
        assert not said["ok"]
        assert why in said["message"]
        client.look()
        assert client.status["step"] == 1


def test_a_message_too_large_ends_the_connection_and_only_that(address):
    with Client(address) as client:
        with pytest.raises(ScenarioError, match=r"connection to the simulator's server broke .*too big"):
            client.ask("x" * MAX_SOCKET_MESSAGE_BYTES)
        with pytest.raises(ScenarioError, match=r"connection to the simulator's server broke .*too big"):
            client.look()
    with Client(address) as client:
        assert client.look() is not None


def test_a_simulator_that_breaks_ends_its_recording_and_not_the_server(tmp_path):
    with cockpit(tmp_path / "r") as found, Client(found) as client:
        client.start("raises", suite="faults")
        client.act(np.zeros((19, 2)))
        with pytest.raises(TeleopRefusal, match="broke on purpose"):
            client.act([0, 0])
        with pytest.raises(TeleopRefusal, match="start a task first"):
            client.finish(as_dropped=True)
        client.start("push-left")
        assert client.act([0, 0])["step"] == 1


def test_a_watching_page_does_not_control(address):
    with Client(address) as first, Client(address) as second:
        with pytest.raises(TeleopRefusal, match="another page drives"):
            first.act([0, 0])
        second.start("push-left", seed=1, discard=True)
        first.ask("drive")
        assert first.act([0, 0])["step"] == 1
