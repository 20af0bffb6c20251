"""Connections to a policy server, and requests spread over them."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from websockets.exceptions import (
    ConnectionClosed,
    InvalidHandshake,
    InvalidMessage,
    InvalidStatus,
    InvalidURI,
)
from websockets.sync.client import ClientConnection, connect

from lerobot_roborecover.policies.remote.errors import (
    RemoteError,
    ServerRefusedError,
    ServerUnavailableError,
    SessionExpiredError,
    WireError,
    printable,
)
from lerobot_roborecover.policies.remote.protocol import pack, unpack
from lerobot_roborecover.policies.remote.sessions import SessionLostError

logger = logging.getLogger(__name__)

_TOO_BIG = 1009
_ATTEMPTS = 3
"""The first may find a connection that the server closed after its last error, as openpi's does."""
_FIRST_DELAY_S, _LONGEST_DELAY_S = 0.1, 5.0
_SHOWN = 2000
_SESSION_LOST = f"{SessionLostError.__name__}: "
"""How a `roborecover serve` begins the words about a session that it does not know."""


@dataclass(frozen=True)
class ServerOptions:
    """Options of the connection to a server."""

    url: str
    timeout_s: float = 120.0
    """For an answer."""
    wait_s: float = 300.0
    """For the server to come up, before the first answer of the run."""
    reconnect_s: float = 60.0
    """For a lost server to come back."""
    connections: int = 8
    """Requests under way at once, at most."""
    max_frame_bytes: int = 64 * 2**20
    """Of an answer."""
    api_key: str | None = None
    greeting: dict[str, Any] | None = None
    """A message that every new connection begins with."""


@dataclass(frozen=True)
class Request:
    """A question for the server."""

    payload: dict[str, Any]
    prelude: dict[str, Any] | None = None
    """A message sent, and answered, just before it on the same connection."""
    session: str = ""
    """Whose trial this is, where a server keeps its state with the connection."""
    step: int = 0
    """Requests of the session before this one."""
    instruction: str = ""
    repeat: int = 1
    """How often it is sent, for as many actions."""
    end: bool = False
    """Whether the session is over; the payload is not looked at."""


class Connection:
    """One websocket, opened when it is needed and again when it is lost.

    Args:
        options: of the server.
        closing: set when nothing more is to be tried.
    """

    def __init__(self, options: ServerOptions, closing: threading.Event):
        self._options, self._closing = options, closing
        self._socket: ClientConnection | None = None
        self.metadata: dict[str, Any] = {}

    def ask(self, request: Request, budget_s: float) -> Any:
        """The server's answer.

        A connection lost under way is opened again and the request sent again: requests are idempotent,
        because servers either keep no history or number the steps of a session.

        Args:
            request: what to send.
            budget_s: how long to try to connect.

        Raises:
            ServerUnavailableError: no connection, lost again and again, or no answer in time.
            ServerRefusedError: the answer is an error text.
            SessionExpiredError: the server has forgotten the request's session.
            WireError: the answer is no message of the protocol, or too large.
        """
        messages = [pack(m) for m in (request.prelude, request.payload) if m is not None]
        for attempt in range(1, _ATTEMPTS + 1):
            if self._closing.is_set():
                raise ServerUnavailableError("closed")
            try:
                socket = self.open(budget_s) if self._socket is None else self._socket
                for message in messages:
                    answer = self._exchange(socket, message)
                return answer
            except ConnectionClosed as err:
                self.close()
                self._check_size(err)
                if err.rcvd is not None and err.rcvd.code == _TOO_BIG:
                    raise WireError(
                        f"{self._options.url} does not take a request of {len(messages[-1]) / 2**20:.1f} MB; "
                        "make the pictures smaller, or raise the server's limit (--max_frame_mb)"
                    ) from err
                if attempt == _ATTEMPTS:
                    raise ServerUnavailableError(
                        f"{self._options.url} closed the connection {attempt} times at this request: {err}"
                    ) from err
                if attempt > 1:  # at first it may only have been an old connection
                    self._closing.wait(_FIRST_DELAY_S * 4**attempt)
            except OSError as err:
                self.close()
                if attempt == _ATTEMPTS:
                    raise ServerUnavailableError(f"{self._options.url}: connection lost: {err}") from err
        raise AssertionError("unreachable")

    def _check_size(self, err: ConnectionClosed) -> None:
        if err.sent is not None and err.sent.code == _TOO_BIG:
            raise WireError(
                f"{self._options.url} sent a frame larger than "
                f"{self._options.max_frame_bytes / 2**20:g} MB (--policy.max_frame_mb)"
            ) from err

    def _exchange(self, socket: ClientConnection, message: bytes) -> Any:
        socket.send(message)
        answer = self._receive(socket)
        if isinstance(answer, str):
            if answer.startswith(_SESSION_LOST):
                raise SessionExpiredError(f"the server reports: {answer.removeprefix(_SESSION_LOST)[:500]}")
            raise ServerRefusedError(f"the server reports an error: {_gist(answer)}")
        return unpack(answer, "the server's answer")

    def _receive(self, socket: ClientConnection) -> bytes | str:
        """Receives the server's next message."""
        try:
            return socket.recv(timeout=self._options.timeout_s)
        except TimeoutError as err:
            self.close()
            raise ServerUnavailableError(
                f"{self._options.url} gave no answer within {self._options.timeout_s:g} s "
                "(--policy.timeout_s)"
            ) from err

    def open(self, budget_s: float) -> ClientConnection:
        """Connects, trying for a while, and reads the metadata.

        Raises:
            ServerUnavailableError: no server answered in time.
            RemoteError: the server that answered is no policy server.
        """
        options, began, delay_s = self._options, time.monotonic(), _FIRST_DELAY_S
        headers = {"Authorization": f"Api-Key {options.api_key}"} if options.api_key else None
        while True:
            try:
                # openpi's server does not answer pings while it infers: silence is for `timeout_s` to judge.
                self._socket = socket = connect(
                    options.url, compression=None, max_size=options.max_frame_bytes, ping_interval=None,
                    open_timeout=10, close_timeout=1, additional_headers=headers, proxy=None,
                )  # fmt: skip
                first = self._first_words(socket)
                break
            except InvalidURI as err:
                raise RemoteError(f"--policy.url={options.url}: {err}; write ws://HOST:PORT") from err
            except InvalidStatus as err:
                raise RemoteError(
                    f"{options.url} answered HTTP {err.response.status_code}, not as a policy server"
                    + ("; set ROBORECOVER_API_KEY" if err.response.status_code == 401 else "")
                ) from err
            except (OSError, EOFError, ConnectionClosed, InvalidMessage, InvalidHandshake) as err:
                self.close()
                if isinstance(err, ConnectionClosed):
                    self._check_size(err)
                left_s = budget_s - (time.monotonic() - began)
                if left_s <= 0:
                    reason = str(err) or type(err).__name__
                    raise ServerUnavailableError(
                        f"no policy server at {options.url} within {budget_s:g} s: {reason}"
                    ) from err
                if delay_s == _FIRST_DELAY_S:
                    logger.warning("waiting up to %g s for a policy server at %s", budget_s, options.url)
                if self._closing.wait(min(delay_s, left_s)):
                    raise ServerUnavailableError("closed") from err
                delay_s = min(2 * delay_s, _LONGEST_DELAY_S)
        self.metadata = self._introduced(socket, first)
        return socket

    def _first_words(self, socket: ClientConnection) -> bytes | str:
        """Receives the server's metadata."""
        return socket.recv(timeout=self._options.timeout_s)

    def _introduced(self, socket: ClientConnection, first: bytes | str) -> dict[str, Any]:
        """The server's metadata.

        Args:
            socket: the new connection.
            first: of `_first_words`.
        """
        if isinstance(first, str):
            raise ServerRefusedError(f"the server's first message is an error: {_gist(first)}")
        metadata = unpack(first, "the server's metadata")
        if not isinstance(metadata, dict):
            raise WireError(f"the server's metadata is a {type(metadata).__name__}, not a map")
        if self._options.greeting is not None:
            self._exchange(socket, pack(self._options.greeting))
        return metadata

    def close(self) -> None:
        """Drops the connection; the next request opens another."""
        socket, self._socket = self._socket, None
        if socket is not None:
            socket.close()


@dataclass
class RemoteServer:
    """A server as several connections see it: `ask` sends requests in parallel."""

    options: ServerOptions
    metadata: dict[str, Any] = field(default_factory=dict)
    """The server's own, once it has been reached."""

    def make_connection(self) -> Connection:
        """A connection that is not open yet."""
        return Connection(self.options, self._closing)

    def __post_init__(self):
        self._closing = threading.Event()
        self._answered = False
        self._idle: queue.LifoQueue[Connection] = queue.LifoQueue()
        self._all = [self.make_connection() for _ in range(self.options.connections)]
        for connection in self._all:
            self._idle.put(connection)
        self._threads = ThreadPoolExecutor(self.options.connections, thread_name_prefix="remote")

    def reach(self) -> dict[str, Any]:
        """Connects, and returns the metadata.

        Raises:
            RemoteError: see `Connection.open`.
        """
        connection = self._idle.get()
        try:
            connection.open(self.options.wait_s)
            self.metadata = connection.metadata
            self._answered = True
        finally:
            self._idle.put(connection)
        return self.metadata

    def ask(self, requests: Sequence[Request]) -> list[Any | RemoteError]:
        """The answers, in order; an error in place of each that failed."""
        try:
            return [future.result() for future in [self._submit(r) for r in requests]]
        except KeyboardInterrupt:  # a request under way would keep the process from ending
            self.close()
            raise

    def tell(self, request: Request) -> None:
        """Sends a request without waiting for its answer."""
        if not self._closing.is_set():
            self._submit(request)

    def close(self) -> None:
        self._closing.set()
        for connection in self._all:
            connection.close()
        self._threads.shutdown(wait=True, cancel_futures=True)

    def _submit(self, request: Request) -> Future:
        return self._threads.submit(self._ask, request)

    def _ask(self, request: Request) -> Any | RemoteError:
        connection = self._idle.get()
        try:
            answer = connection.ask(
                request, self.options.reconnect_s if self._answered else self.options.wait_s
            )
            self._answered = True
            return answer
        except RemoteError as err:
            return err
        finally:
            self._idle.put(connection)


def _gist(text: str) -> str:
    """An error text's last line, which is what a traceback is about; all of it goes to the log."""
    if "\n" in text.strip():
        logger.warning(
            "the server says:\n%s", "\n".join(printable(line) for line in text[-_SHOWN:].splitlines())
        )
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1][:500] if lines else "(no words)"
