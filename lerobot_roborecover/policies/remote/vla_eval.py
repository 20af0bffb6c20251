"""vla-eval's protocol: messages with a type and a number, an episode a connection, one action an observation.

Read from `vla-eval` 0.8.0 on PyPI: `protocol/messages.py`, `protocol/numpy_codec.py`, `connection.py`,
`protocol/image_codec.py`, `model_servers/serve.py`, `specs.py`. A server keeps an episode's state with its
connection: a connection that is lost takes its episode with it.
"""

from __future__ import annotations

import io
import itertools
import queue
import threading
import time
from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np
from PIL import Image
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from lerobot_roborecover._version import __version__
from lerobot_roborecover.policies.remote.connection import Connection, RemoteServer, Request, ServerOptions
from lerobot_roborecover.policies.remote.errors import (
    MappingError,
    RemoteError,
    ServerRefusedError,
    ServerUnavailableError,
    SessionExpiredError,
    WireError,
)
from lerobot_roborecover.policies.remote.mapping import Specs
from lerobot_roborecover.policies.remote.protocol import checked_array, unpack_bounded

VERSION = 1
"""Of the protocol."""
_UNCHECKED = "raw"
"""A format that a server declares where it has no convention."""


def pack_message(kind: str, payload: Mapping[str, Any], number: int) -> bytes:
    """Bytes of a message.

    Args:
        kind: `hello`, `episode_start`, `observation` or `episode_end`.
        payload: plain values and arrays; pictures, (H, W, C) uint8, travel as PNG.
        number: comes back with the answer.

    Raises:
        WireError: the payload holds something that the protocol does not carry.
    """
    message = {"type": kind, "payload": dict(payload), "seq": number, "timestamp": time.time()}
    try:
        return msgpack.packb(message, default=_encode)
    except (TypeError, ValueError, OverflowError) as err:
        raise WireError(f"cannot be sent: {err}") from err


def unpack_message(data: bytes | str) -> tuple[str, Any, int]:
    """Kind, payload and number of a message.

    Raises:
        WireError: the bytes are none, or hold more than any answer does.
    """
    if isinstance(data, str):
        raise WireError("the server's answer is a text; vla-eval's are binary")
    message = unpack_bounded(data, "the server's answer", "vla-eval's msgpack", _decode)
    fields = ("type", "payload", "seq")
    if not isinstance(message, dict) or any(name not in message for name in fields):
        raise WireError(f"the server's answer is no message of vla-eval: {message!r:.100}")
    kind, payload, number = (message[name] for name in fields)
    if not isinstance(kind, str) or not isinstance(number, int):
        raise WireError(f"the server's answer has type {kind!r:.40} and number {number!r:.40}")
    return kind, payload, number


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            raise ValueError(
                f"arrays of dtype {value.dtype} are not sent; only booleans, integers and floats"
            )
        if value.ndim == 3 and value.dtype == np.uint8 and value.shape[2] in (1, 3, 4):
            buffer = io.BytesIO()
            Image.fromarray(value[:, :, 0] if value.shape[2] == 1 else value).save(buffer, format="PNG")
            return {
                "__image__": True, "format": "png", "data": buffer.getvalue(), "shape": list(value.shape)
            }  # fmt: skip
        shape = list(value.shape)
        return {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": shape}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a {type(value).__name__} is not sent; only plain values and arrays")


def _decode(value: dict) -> Any:
    if "__image__" in value:
        raise ValueError("an answer holds no pictures")
    if "__ndarray__" in value:
        return checked_array(value.get("dtype"), value.get("shape"), value.get("data"))
    return value


class EpisodeConnection(Connection):
    """One connection, which runs one episode at a time.

    Args:
        options: of the server; `greeting` goes into every `episode_start`, beside the task.
        closing: set when nothing more is to be tried.
    """

    def __init__(self, options: ServerOptions, closing: threading.Event):
        super().__init__(options, closing)
        self._numbers = itertools.count(1)

    def ask(self, request: Request, budget_s: float) -> Any:
        """The actions, `{"actions": (n, A)}`, for an observation that is sent `request.repeat` times: a
        server with a chunk gives one of its actions each time.

        Raises:
            SessionExpiredError: the connection was lost after the episode's first observation.
            ServerUnavailableError: the server does not answer.
            ServerRefusedError: the server reports an error.
            WireError: the answer is no message of the protocol, or no actions.
        """
        if not request.step:
            self._begin(request, budget_s)
        socket = self._socket
        if socket is None:
            raise SessionExpiredError(f"{self._options.url}: the episode's connection is lost")
        try:
            rows = [self._act(socket, request.payload) for _ in range(request.repeat)]
        except (ConnectionClosed, OSError) as err:
            self.close()
            if isinstance(err, ConnectionClosed):
                self._check_size(err)
            if request.step:
                raise SessionExpiredError(
                    f"{self._options.url} closed the episode's connection: {err}"
                ) from err
            raise ServerUnavailableError(f"{self._options.url} closed the connection: {err}") from err
        return {"actions": np.stack(rows)}

    def end(self) -> None:
        """Ends the episode without waiting for an answer."""
        if self._socket is not None:
            try:
                self._socket.send(pack_message("episode_end", {}, next(self._numbers)))
            except (ConnectionClosed, OSError):
                self.close()

    def _begin(self, request: Request, budget_s: float) -> None:
        task = {"name": request.instruction, **(self._options.greeting or {})}
        message = pack_message("episode_start", {"task": task}, next(self._numbers))
        for attempt in range(2):  # the first may find a connection that the server closed meanwhile
            socket = self.open(budget_s) if self._socket is None else self._socket
            try:
                socket.send(message)
                return
            except (ConnectionClosed, OSError) as err:
                self.close()
                if attempt:
                    raise ServerUnavailableError(f"{self._options.url} closed the connection: {err}") from err

    def _act(self, socket: ClientConnection, observation: Mapping[str, Any]) -> np.ndarray:
        number = next(self._numbers)
        socket.send(pack_message("observation", observation, number))
        kind, payload, answered = unpack_message(self._receive(socket))
        if kind == "error":
            # What else is on its way belongs to an episode that the server did not begin.
            self.close()
            said = payload.get("error") if isinstance(payload, dict) else payload
            raise ServerRefusedError(f"the server reports an error: {said!s:.500}")
        if kind != "action" or answered != number:
            self.close()
            raise WireError(f"the server answered observation {number} with {kind!r:.40} {answered}")
        return _one_action(payload)

    def _first_words(self, socket: ClientConnection) -> bytes | str:
        hello = {"harness_version": f"roborecover {__version__}", "protocol_version": VERSION}
        socket.send(pack_message("hello", hello, next(self._numbers)))
        return socket.recv(timeout=self._options.timeout_s)

    def _introduced(self, socket: ClientConnection, first: bytes | str) -> dict[str, Any]:
        kind, payload, _ = unpack_message(first)
        if kind != "hello" or not isinstance(payload, dict):
            raise WireError(f"{self._options.url} answered 'hello' with {kind!r:.40}")
        if payload.get("protocol_version") != VERSION:
            raise MappingError(
                f"{self._options.url} speaks version {payload.get('protocol_version')!r:.40} of vla-eval's "
                f"protocol, this side version {VERSION}"
            )
        return payload


def _one_action(payload: Any) -> np.ndarray:
    """(A,) numbers of an answer."""
    found = payload.get("actions", payload.get("action")) if isinstance(payload, dict) else None
    action = np.asarray(found) if isinstance(found, np.ndarray | list) else None
    if action is not None and action.ndim == 2 and len(action) == 1:
        action = action[0]
    if action is None or action.dtype.kind not in "biuf" or action.ndim != 1 or not action.size:
        shape = None if action is None else action.shape
        raise WireError(
            f"the server's actions have shape {shape}; vla-eval gives one action an observation. A server "
            "that sends whole chunks is started with its chunk size (--args.chunk_size)"
        )
    return action


class EpisodeServer(RemoteServer):
    """A server as several episodes see it, each pinned to a connection of its own."""

    def make_connection(self) -> Connection:
        """A connection that is not open yet."""
        return EpisodeConnection(self.options, self._closing)

    def __post_init__(self):
        super().__post_init__()
        self._pinned: dict[str, EpisodeConnection] = {}
        self._lock = threading.Lock()

    def _ask(self, request: Request) -> Any | RemoteError:
        with self._lock:
            connection = self._pinned.get(request.session)
            if request.end or request.step:
                if connection is None:
                    return None if request.end else SessionExpiredError("the episode's connection is lost")
            elif connection is None:
                connection = self._pinned[request.session] = self._idle_or_new()
        assert connection is not None
        if request.end:
            connection.end()
            self._leave(request.session)
            return None
        try:
            answer = connection.ask(
                request, self.options.reconnect_s if self._answered else self.options.wait_s
            )
            self._answered = True
            return answer
        except RemoteError as err:
            connection.end()
            self._leave(request.session)
            return err

    def _leave(self, session: str) -> None:
        with self._lock:
            connection = self._pinned.pop(session, None)
        if connection is not None:
            self._idle.put(connection)

    def _idle_or_new(self) -> EpisodeConnection:
        try:
            found = self._idle.get_nowait()
        except queue.Empty:
            found = self.make_connection()
            self._all.append(found)
        assert isinstance(found, EpisodeConnection)
        return found


def wanted(hello: Mapping[str, Any]) -> frozenset[str]:
    """Observation parameters that a server asks its benchmark for, those that are true.

    Args:
        hello: its answer to `hello`.
    """
    params = hello.get("observation_params")
    return frozenset(str(k) for k, v in params.items() if v) if isinstance(params, dict) else frozenset()


def check_specs(hello: Mapping[str, Any], ours: Specs, width: int | None, url: str) -> None:
    """Refuses a server whose actions or observations are not those of the mapping, before a simulator starts.

    Args:
        hello: the server's answer to `hello`.
        ours: what the mapping takes and gives.
        width: values in an action of the environment.
        url: of the server, for the message.

    Raises:
        MappingError: naming what differs.
    """
    problems = []
    theirs = _components(hello.get("action_spec"))
    if theirs and width is not None:
        dims = [int(spec.get("dims") or 0) for spec in theirs.values()]
        if all(dims) and sum(dims) != width:
            problems.append(f"its actions have width {sum(dims)}, the environment takes {width}")
    for name, accepted in ours.action.items():
        if not theirs:
            break
        spec = theirs.get(name)
        if spec is None:
            problems.append(f"its actions have no {name}; they have {sorted(theirs)}")
        elif spec.get("format") not in (accepted, _UNCHECKED):
            problems.append(f"its {name} is {spec.get('format')!r:.60}; the mapping takes {accepted!r}")
    for name, spec in _components(hello.get("observation_spec")).items():
        given = ours.observation.get(name)
        accepts = spec.get("accepts") or [spec.get("format")]
        if given is None:
            problems.append(f"it looks at {name}; the mapping gives {sorted(ours.observation)}")
        elif given not in accepts and _UNCHECKED not in accepts:
            problems.append(f"it looks at {name} as {accepts!r:.80}; the mapping gives {given!r}")
    if problems:
        raise MappingError(f"the server at {url} does not fit: {'; '.join(problems)}")


def _components(spec: Any) -> Mapping[str, Mapping[str, Any]]:
    if not isinstance(spec, dict):
        return {}
    return {str(name): part for name, part in spec.items() if isinstance(part, dict)}
