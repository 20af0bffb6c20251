"""GR00T's protocol: a question and its answer over ZeroMQ, as msgpack, with arrays as `np.save` writes them.

Read from NVIDIA/Isaac-GR00T at ade260e (N1.6, N1.7), `gr00t/policy/server_client.py` and `gr00t_policy.py`,
and at 0a015f6 (N1.5), `gr00t/eval/service.py`. A server has one policy for all of its clients, and answers
them in turn.
"""

from __future__ import annotations

import io
import json
import threading
import time
from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np
import zmq
from numpy.lib import format as npy
from zmq.utils.monitor import recv_monitor_message

from lerobot_roborecover.policies.remote.connection import Connection, RemoteServer, Request, ServerOptions
from lerobot_roborecover.policies.remote.errors import (
    RemoteError,
    ServerRefusedError,
    ServerUnavailableError,
    WireError,
)
from lerobot_roborecover.policies.remote.protocol import checked_dtype, unpack_bounded

_ATTEMPTS = 3
_LOOK_MS = 50
"""Between two looks whether the run is over."""
_HEARTBEAT_MS = 10_000
"""ZeroMQ's own, answered while the policy infers: a machine that vanished is noticed."""
_LONGEST_HEADER = 1000
"""Characters of an array's header; ours have some eighty."""
_UNAUTHORIZED = "Unauthorized"
_ERROR = b"ERROR"
"""What a server of another kind says."""


def pack_call(endpoint: str, data: Mapping[str, Any] | None = None, token: str | None = None) -> bytes:
    """Bytes of a question.

    Args:
        endpoint: `ping`, `get_modality_config`, `reset` or `get_action`.
        data: plain values and arrays; None where the endpoint takes none.
        token: the server's, where it wants one.

    Raises:
        WireError: the data hold something that the protocol does not carry.
    """
    call: dict[str, Any] = {"endpoint": endpoint}
    if data is not None:
        call["data"] = dict(data)
    if token is not None:
        call["api_token"] = token
    try:
        return msgpack.packb(call, default=_encode)
    except (TypeError, ValueError, OverflowError) as err:
        raise WireError(f"cannot be sent: {err}") from err


def unpack_answer(data: bytes) -> Any:
    """The answer of some bytes; arrays are read-only.

    Raises:
        ServerRefusedError: it is an error in words.
        WireError: the bytes are none, or hold more than any answer does.
    """
    if data == _ERROR:
        raise ServerRefusedError("the server answers ERROR: it is no policy server of GR00T")
    answer = unpack_bounded(data, "the server's answer", "GR00T's msgpack", _decode)
    if isinstance(answer, dict) and "error" in answer:
        raise ServerRefusedError(f"the server reports an error: {answer['error']!s:.500}")
    return answer


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            raise ValueError(
                f"arrays of dtype {value.dtype} are not sent; only booleans, integers and floats"
            )
        out = io.BytesIO()
        np.save(out, value, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": out.getvalue()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a {type(value).__name__} is not sent; only plain values and arrays")


def _decode(value: dict) -> Any:
    if "__ndarray_class__" in value:
        return read_npy(value.get("as_npy"))
    if "__ModalityConfig_class__" in value:
        content = value.get("as_json")
        return json.loads(content) if isinstance(content, str) else content  # N1.5 writes a text
    return value


def read_npy(data: Any) -> np.ndarray:
    """A read-only array of the bytes of an .npy file.

    numpy's own reader makes room for what a header claims, and opens archives: here the size is compared
    first, and only booleans, integers and floats are taken.

    Args:
        data: as it came.

    Raises:
        ValueError: these are not such an array.
    """
    if not isinstance(data, bytes):
        raise ValueError(f"an array of {type(data).__name__} data")
    file = io.BytesIO(data)
    version = npy.read_magic(file)
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"an array of .npy version {version}; only 1.0 and 2.0 are taken")
    header = int.from_bytes(data[8 : 10 if version == (1, 0) else 12], "little")
    if header > _LONGEST_HEADER:
        raise ValueError(
            f"an array whose header has {header} characters; at most {_LONGEST_HEADER} are taken"
        )
    shape, fortran, dtype = readers[version](file)
    dtype = checked_dtype(dtype.str)
    if any(n < 0 for n in shape):
        raise ValueError(f"array of shape {shape!r:.100}")
    count, left = 1, len(data) - file.tell()
    for n in shape:
        count *= n
    if count * dtype.itemsize != left:
        raise ValueError(f"array of shape {shape!r:.100} and dtype {dtype} with {left} bytes of data")
    return np.frombuffer(data, dtype, offset=file.tell()).reshape(shape, order="F" if fortran else "C")


class CallConnection(Connection):
    """One REQ socket, opened when it is needed and again when its question is lost.

    Args:
        options: of the server.
        closing: set when nothing more is to be tried.
        context: ZeroMQ's, of all connections.
    """

    def __init__(self, options: ServerOptions, closing: threading.Event, context: zmq.Context):
        super().__init__(options, closing)
        self._context = context
        self._calls: zmq.Socket | None = None
        self._events: zmq.Socket | None = None

    def ask(self, request: Request, budget_s: float) -> Any:
        """The actions of an observation: a map of (1, n, A_i) arrays, or (n, A_i).

        Raises:
            ServerUnavailableError: the server does not answer, or the connection is lost repeatedly.
            ServerRefusedError: the server reports an error.
            WireError: the answer is no message of the protocol.
        """
        calls = [pack_call("get_action", request.payload, self._options.api_key)]
        if request.prelude is not None:
            calls.insert(0, pack_call("reset", request.prelude, self._options.api_key))
        for attempt in range(1, _ATTEMPTS + 1):
            if self._calls is None:
                self.reach(budget_s)
            try:
                for call in calls:
                    answer = self._call(call, self._options.timeout_s)
                return _actions(answer)
            except _LostError as err:
                if attempt == _ATTEMPTS:
                    raise ServerUnavailableError(
                        f"{self._options.url} closed the connection {attempt} times at this request; so it "
                        f"is, too, with an answer of more than {self._options.max_frame_bytes / 2**20:g} MB "
                        "(--policy.max_frame_mb)"
                    ) from err
        raise AssertionError("unreachable")

    def reach(self, budget_s: float) -> None:
        """Connects, and waits for the answer to a ping.

        A server that infers for another client answers later: all clients share one queue.

        Raises:
            ServerUnavailableError: no server answered in time.
            RemoteError: the server that answered wants another token, or is no GR00T server.
        """
        self.close()
        options = self._options
        deadline = time.monotonic() + budget_s
        self._calls = socket = self._context.socket(zmq.REQ)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.MAXMSGSIZE, options.max_frame_bytes)
        socket.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
        socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 3 * _HEARTBEAT_MS)
        socket.setsockopt(zmq.RECONNECT_IVL, 100)
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, 5000)
        self._events = socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        try:
            socket.connect(options.url)
        except zmq.ZMQError as err:
            self.close()
            raise RemoteError(f"--policy.url={options.url}: {err}; write tcp://HOST:PORT") from err
        try:
            self._call(pack_call("ping", token=options.api_key), max(0.0, deadline - time.monotonic()))
        except ServerRefusedError as err:
            self.close()
            hint = "; set ROBORECOVER_API_KEY to the server's token" if _UNAUTHORIZED in str(err) else ""
            raise RemoteError(f"{options.url}: {err}{hint}") from err
        except _LostError as err:
            raise ServerUnavailableError(f"{options.url} closed the connection at a ping: {err}") from err
        except ServerUnavailableError as err:
            if self._closing.is_set():
                raise
            raise ServerUnavailableError(f"no policy server at {options.url} within {budget_s:g} s") from err

    def describe(self) -> Any:
        """The server's modalities, as it declares them; None where it does not.

        Raises:
            ServerUnavailableError: it gave no answer.
        """
        try:
            return self._call(
                pack_call("get_modality_config", token=self._options.api_key), self._options.timeout_s
            )
        except ServerRefusedError:
            return None
        except _LostError as err:
            raise ServerUnavailableError(f"{self._options.url}: connection lost: {err}") from err

    def close(self) -> None:
        """Drops the socket; the next question opens another. Not while another thread uses it."""
        socket, self._calls = self._calls, None
        events, self._events = self._events, None
        if socket is not None:
            socket.disable_monitor()
            socket.close(0)
        if events is not None:
            events.close(0)

    def _call(self, call: bytes, timeout_s: float) -> Any:
        """An answer.

        Raises:
            ServerUnavailableError: none came in time; the socket is dropped.
            _LostError: the connection went away meanwhile; the socket is dropped.
        """
        socket, events = self._calls, self._events
        assert socket is not None
        assert events is not None
        while events.poll(0):  # of a time before this question
            recv_monitor_message(events)
        socket.send(call)
        poller = zmq.Poller()
        poller.register(socket, zmq.POLLIN)
        poller.register(events, zmq.POLLIN)
        deadline = time.monotonic() + timeout_s
        while True:
            left_ms = 1000 * (deadline - time.monotonic())
            ready = dict(poller.poll(max(1, int(min(_LOOK_MS, left_ms)))))
            if socket in ready:
                return unpack_answer(socket.recv())
            if events in ready:
                self.close()
                raise _LostError("it was closed before an answer")
            if self._closing.is_set() or left_ms <= 0:
                self.close()
                raise ServerUnavailableError(
                    "closed" if self._closing.is_set() else f"{self._options.url} gave no answer within "
                    f"{timeout_s:g} s (--policy.timeout_s)"
                )  # fmt: skip


class _LostError(RemoteError):
    """The connection broke under a question."""


def _actions(answer: Any) -> dict[str, np.ndarray]:
    """The arrays of an answer: N1.6 and later send them with a second map, of which nothing is used."""
    found = answer[0] if isinstance(answer, list) and answer else answer
    if not isinstance(found, dict):
        raise WireError(f"the server's actions are a {type(found).__name__}, not a map of arrays")
    return {
        str(key): value[:, None] if isinstance(value, np.ndarray) and value.ndim == 1 else value
        for key, value in found.items()
    }


class CallServer(RemoteServer):
    """A server as several sockets see it."""

    def make_connection(self) -> Connection:
        """A socket that is not open yet."""
        return CallConnection(self.options, self._closing, self._context)

    def __post_init__(self):
        self._context = zmq.Context()
        super().__post_init__()

    def reach(self) -> dict[str, Any]:
        """Connects, and returns what the server declares of its modalities.

        Raises:
            RemoteError: see `CallConnection.reach`.
        """
        connection = self._idle.get()
        assert isinstance(connection, CallConnection)
        try:
            connection.reach(self.options.wait_s)
            declared = connection.describe()
            self.metadata = declared if isinstance(declared, dict) else {}
            self._answered = True
        finally:
            self._idle.put(connection)
        return self.metadata

    def close(self) -> None:
        """Closes every socket, each once no thread uses it any more."""
        self._closing.set()
        self._threads.shutdown(wait=True, cancel_futures=True)
        for connection in self._all:
            connection.close()
        self._context.term()
