"""What a policy server holds over all of its clients together, and what of a peer's words is shown."""

from __future__ import annotations

import logging
import resource
import socket
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from unittest.mock import Mock

import numpy as np
import pytest
import websockets.sync.client
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.policies.remote import limits, sockets
from lerobot_roborecover.policies.remote.errors import RemoteError, ServerRefusedError
from lerobot_roborecover.policies.remote.limits import SHARE_BYTES, ByteBudget, LimitedConnection, WrongKeys
from lerobot_roborecover.policies.remote.protocol import pack, unpack
from lerobot_roborecover.policies.remote.sessions import RequestError
from tests.support.policy_servers import OpenpiServer, ask, serving
from tests.support.processes import PATIENCE_S
from tests.support.serve_loop import STATE, checkpoints, load  # noqa: F401 - a fixture
from tests.support.tls import certificate

pytestmark = pytest.mark.lerobot


class Policy:
    """A policy that answers with the sum of its state."""

    max_batch, horizon, action_width, resumable = 8, 1, 2, False

    def __init__(self):
        self.may_answer = threading.Event()
        self.may_answer.set()

    def metadata(self, name):
        return {"server": "test"}

    def check(self, content):
        return {k: v for k, v in content.items() if k.startswith("observation.")}

    def batch_key(self, observation):
        return None

    def start(self, seed, step=0):
        return seed

    def finish(self, history):
        pass

    def act(self, observations, instructions, histories):
        assert self.may_answer.wait(PATIENCE_S)
        return [np.array([[float(o["observation.state"].sum()), 0]]) for o in observations]


def connect(url, **options):
    return websockets.sync.client.connect(url, open_timeout=PATIENCE_S, **options)


def request(size, value=1):
    return pack({"observation.state": np.full(size, value, np.uint8)})


# --- what the policy takes


def test_what_the_policy_does_not_take_is_not_converted(checkpoints):  # noqa: F811
    policy = load(checkpoints, "act")
    extra = {f"observation.images.extra{i}": np.zeros((900, 900, 3), np.uint8) for i in range(3)}
    taken = policy.check({**STATE, **extra, "task": "push"})
    assert set(taken) == set(STATE)
    key = "observation.images.front"
    policy.expected[key] = type("Feature", (), {"shape": (3, 96, 96), "type": "VISUAL"})()
    with pytest.raises(RequestError, match="the limits are 12582912 numbers"):
        policy.check({**STATE, key: np.zeros((4000, 4000, 3), np.uint8)})


def test_pictures_become_the_same_floats_as_before():
    import torch

    from lerobot_roborecover.policies.remote.served import _tensor

    pixels = np.random.default_rng(0).integers(0, 256, (2, 5, 7, 3), np.uint8)
    expected = torch.from_numpy(pixels).permute(0, 3, 1, 2).contiguous().type(torch.float32) / 255
    assert torch.equal(_tensor(pixels), expected)


# --- connections


def test_connections_beyond_the_limit_are_refused_until_one_ends():
    with serving(Policy(), max_connections=2) as (url, server):
        clients = [connect(url), connect(url)]
        for client in clients:
            client.recv()
        with pytest.raises(InvalidStatus) as refused:
            connect(url)
        assert refused.value.response.status_code == 503
        clients[0].close()
        while server._connections == 2:
            pass
        with connect(url) as client:
            assert unpack(client.recv()) == {"server": "test"}
        clients[1].close()


CROWD = """
import resource, socket, ssl, sys, time
import websockets.sync.client
most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
port, cert = sys.stdin.readline().split()
silent = [socket.create_connection(("127.0.0.1", int(port))) for _ in range(100)]
context = ssl.create_default_context(cafile=cert)
for attempt in range(1000):
    try:
        with websockets.sync.client.connect(f"wss://127.0.0.1:{port}", ssl=context, open_timeout=5) as client:
            print(client.recv()[-4:])
            break
    except (OSError, EOFError) as err:
        print(repr(err), file=sys.stderr)
        time.sleep(0.05)
"""


@pytest.mark.parametrize("limit", [16, 1000])
def test_silent_clients_leave_room_for_others_and_no_tracebacks(tmp_path, monkeypatch, caplog, limit):
    """Either limit holds: of sockets that are opening, or of what descriptors the process has."""
    monkeypatch.setattr(sockets, "MAX_OPENING", limit)
    cert, key = certificate(tmp_path)
    crowd = subprocess.Popen(
        [sys.executable, "-c", CROWD],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with serving(Policy(), certfile=cert, keyfile=key) as (url, _):
        with socket.socket() as probe:
            resource.setrlimit(resource.RLIMIT_NOFILE, (probe.fileno() + 40, before[1]))
        try:
            port = url.rsplit(":", 1)[1]
            said, errors = crowd.communicate(f"{port} {cert}\n", timeout=PATIENCE_S)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert said == "b'test'\n", errors
    assert not [r.getMessage() for r in caplog.records if r.exc_info or "Traceback" in r.getMessage()]


# --- bytes


class Reader:
    """Stands in for a connection's transport."""

    def __init__(self):
        self.reading = True
        self.transport = self

    def pause_reading(self):
        self.reading = False

    def resume(self):
        self.reading = True


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 6)), max_size=60))
def test_over_the_budget_one_large_request_is_read_at_a_time(events):
    budget = ByteBudget(4 * SHARE_BYTES)
    readers, held = [Reader() for _ in range(5)], [0] * 5
    for number, share in events:
        grows = share * SHARE_BYTES > held[number]
        if grows and not readers[number].reading:
            continue  # nothing arrives from it
        held[number] = share * SHARE_BYTES
        budget.update(readers[number], held[number])
        assert budget.held == sum(held)
        large = [r for r, size in zip(readers, held, strict=True) if size > SHARE_BYTES]
        assert all(r.reading for r in readers if r not in large)
        assert not large or any(r.reading for r in large)
        assert budget.held > 4 * SHARE_BYTES or all(r.reading for r in readers)
    budget.drop(readers[0])
    for reader in readers[1:]:
        budget.update(reader, 0)
    assert budget.held == 0
    assert all(r.reading for r in readers[1:])


def test_requests_over_the_budget_wait_and_are_all_answered(monkeypatch):
    most, size, frame = [0], 4 * 2**20, 6 * 2**20
    update = ByteBudget.update

    def watched(self, connection, held):
        update(self, connection, held)
        most[0] = max(most[0], self.held)

    monkeypatch.setattr(ByteBudget, "update", watched)
    policy = Policy()
    policy.may_answer.clear()
    limit = 8 * 2**20
    with (
        serving(policy, max_pending_bytes=limit, max_frame_bytes=frame) as (url, server),
        ExitStack() as stack,
        ThreadPoolExecutor(8) as threads,
    ):
        clients = [stack.enter_context(connect(url)) for _ in range(8)]

        def exchange(client, size):
            client.recv()
            client.send(request(size))
            return unpack(client.recv(timeout=PATIENCE_S))["actions"][0][0]

        answers = [threads.submit(exchange, client, size) for client in clients[:7]]
        while server.budget.held <= limit:
            pass
        # A small request is read at once, whatever the others hold.
        answers.append(threads.submit(exchange, clients[7], 100))
        policy.may_answer.set()
        assert [a.result() for a in answers] == [size] * 7 + [100]
        for client in clients:
            client.close()
        while server.budget.held:
            pass
    # Each connection may go beyond by what it reads at once; without a budget all 28 MiB are held.
    assert limit < most[0] <= limit + frame + 8 * SHARE_BYTES


def test_a_large_request_that_stops_half_way_is_closed_and_others_go_on(monkeypatch, caplog):
    monkeypatch.setattr(limits, "RECEIVE_TIMEOUT_S", 0.2)
    with serving(Policy(), max_pending_bytes=4 * 2**20) as (url, server):
        with connect(url) as slow, connect(url) as other:
            slow.recv()
            other.recv()
            # A frame's beginning: binary, masked, of 8 MiB, of which 5 arrive.
            slow.socket.sendall(b"\x82\xff" + (8 * 2**20).to_bytes(8, "big") + bytes(4) + bytes(5 * 2**20))
            while server.budget.held <= SHARE_BYTES and "did not arrive" not in caplog.text:
                pass
            # The slow one's time is running; a busy machine is not to close the other one, too.
            monkeypatch.setattr(limits, "RECEIVE_TIMEOUT_S", PATIENCE_S)
            other.send(request(3 * 2**20))
            assert unpack(other.recv(timeout=PATIENCE_S))["actions"][0][0] == 3 * 2**20
            with pytest.raises(ConnectionClosed):
                slow.recv(timeout=PATIENCE_S)
        while server.budget.held:
            pass
    assert "did not arrive within" in caplog.text


def test_time_in_which_a_connection_is_not_read_from_is_not_counted():
    armed = []

    class Loop:
        def call_later(self, delay, callback):
            armed.append(callback)
            return Mock()

    connection = LimitedConnection.__new__(LimitedConnection)
    connection.loop, connection.transport = Loop(), Mock()
    connection._deadline = None
    connection._start_deadline()
    before = connection._deadline
    connection.resume()
    before.cancel.assert_called_once_with()
    assert len(armed) == 2
    connection.transport.resume_reading.assert_called_once_with()


# --- keys


def test_wrong_keys_are_answered_ever_later_and_logged_ever_more_rarely(caplog):
    now = [0.0]
    keys = WrongKeys(lambda: now[0])
    delays = [keys.note("10.0.0.1") for _ in range(1000)]
    assert delays[:4] == [0.1, 0.2, 0.4, 0.8]
    assert delays == sorted(delays)
    assert max(delays) == limits.LONGEST_DELAY_S
    assert keys.note("10.0.0.2") == 0.1, "another address is not slowed"
    assert len(caplog.records) == 10 + 1
    assert "from 10.0.0.1, 512 so far" in caplog.text
    now[0] = 1e4
    assert keys.note("10.0.0.1") == 0.1
    for i in range(10_000):
        keys.note(str(i))
    assert len(keys._seen) <= 4096


def test_a_wrong_key_is_logged_and_a_strange_one_is_only_wrong(caplog):
    with serving(Policy(), api_key="sixteen-letters-or-more") as (url, _):
        for given in ("Api-Key x", "Api-Key \xff\xfe", ""):
            with pytest.raises(InvalidStatus) as refused:
                connect(url, additional_headers={"Authorization": given})
            assert refused.value.response.status_code == 401
    lines = [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]
    assert lines == [
        f"wrong or missing API key from 127.0.0.1, {n} so far; answers are slowed" for n in (1, 2)
    ]


def test_a_short_key_is_refused_at_start(checkpoints, capsys, monkeypatch):  # noqa: F811
    monkeypatch.setattr(sys, "argv", ["roborecover"])
    monkeypatch.setenv("ROBORECOVER_API_KEY", "fifteen-letters")
    assert main(["serve", f"--policy.path={checkpoints['act']}", "--policy.device=cpu"]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "has 15 characters; a server's key has 16 or more" in said
    assert "fifteen-letters" not in said


# --- what a peer says

ESCAPES = "\x1b[2J\x1b]0;owned\x07\r\x9b31m\u202edone"


def is_clean(text):
    return all(c.isprintable() or c == "\n" for c in text)


@given(st.text())
def test_errors_about_a_peer_are_printable(text):
    assert is_clean(str(RemoteError(text)))
    assert str(RemoteError("plain words: (1, 2) é 日")) == "plain words: (1, 2) é 日"


def _closes(request, connection):
    connection.close(1011, ESCAPES)
    raise ConnectionClosed(None, None)


@pytest.mark.parametrize(
    "server",
    [
        OpenpiServer(lambda request, connection: f"one\n{ESCAPES}\nKeyError: {ESCAPES}"),
        OpenpiServer(_closes),
        OpenpiServer(lambda request, connection: b"", metadata=f"Traceback\n{ESCAPES}"),
        OpenpiServer(lambda request, connection: b"", metadata={ESCAPES: ESCAPES}),
    ],
)
def test_escapes_of_a_server_reach_neither_terminal_nor_log(server, caplog, capfd):
    caplog.set_level(logging.INFO)
    with server.running() as url:
        (answer,) = ask(url, {"state": np.zeros(2)})
    assert isinstance(answer, RemoteError | ServerRefusedError)
    assert is_clean(str(answer)), repr(str(answer))
    assert is_clean(caplog.text), repr(caplog.text)
    assert is_clean("".join(capfd.readouterr()))


def test_escapes_of_a_client_reach_no_log(caplog):
    caplog.set_level(logging.INFO)

    class Fails(Policy):
        def act(self, observations, instructions, histories):
            raise ValueError(f"cannot tokenize {instructions[0]}")

    with serving(Fails()) as (url, server):
        with connect(url) as client:
            client.recv()
            client.send(pack({"observation.state": np.zeros(2), "task": ESCAPES}))
            assert is_clean(client.recv())
            client.close(4000, ESCAPES)
        while server._connections:
            pass
    assert "cannot tokenize" in caplog.text
    assert "4000" in caplog.text
    assert is_clean(caplog.text), repr(caplog.text)
