"""A policy server: openpi's protocol on a websocket, requests of all connections inferred together."""

from __future__ import annotations

import asyncio
import http
import ipaddress
import logging
import secrets
import signal
import ssl
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from lerobot_roborecover.policies.remote.errors import RemoteError, printable
from lerobot_roborecover.policies.remote.limits import ByteBudget, LimitedConnection, WrongKeys
from lerobot_roborecover.policies.remote.protocol import pack, unpack
from lerobot_roborecover.policies.remote.served import ServedPolicy
from lerobot_roborecover.policies.remote.sessions import Envelope, RequestError, Sessions, read_envelope
from lerobot_roborecover.policies.remote.sockets import OpeningSockets
from lerobot_roborecover.policies.runner import Chunk, PolicyError
from lerobot_roborecover.utils.signals import STOP_SIGNALS

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ServeOptions:
    """Options of a policy server."""

    host: str = "127.0.0.1"
    port: int = 8000
    """0 takes a free one."""
    batch_delay_s: float = 0.005
    max_frame_bytes: int = 64 * 2**20
    max_sessions: int = 256
    max_connections: int = 256
    max_pending_bytes: int = 256 * 2**20
    """Of requests that have arrived and are not answered yet, over all connections."""
    api_key: str | None = None
    """Key that clients must send; None admits every client."""
    certfile: str = ""
    """TLS certificate chain, PEM; empty serves without TLS."""
    keyfile: str = ""
    """Its private key, PEM; empty where the certificate's file holds it."""

    def tls(self) -> ssl.SSLContext | None:
        """The server's side of TLS; None without.

        Raises:
            RemoteError: the files cannot be used.
        """
        if not self.certfile:
            return None
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            context.load_cert_chain(self.certfile, self.keyfile or None)
        except (OSError, ssl.SSLError) as err:
            raise RemoteError(
                f"--certfile={self.certfile} --keyfile={self.keyfile}: {err}. They are PEM files: the "
                "certificate with its chain, and its private key without a passphrase"
            ) from err
        return context


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address to listen on.

    Args:
        host: a name or an IP address.
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass
class _Question:
    observation: dict
    instruction: str
    history: Any
    answer: asyncio.Future


class Batcher:
    """Requests that arrive together are inferred together, in one thread that nothing else uses.

    Args:
        policy: with `act`, `start` and `finish`.
        delay_s: how long a request waits for others to share its batch.
        expected: returns how many requests may come at most, now.
    """

    def __init__(self, policy: ServedPolicy, delay_s: float, expected: Callable[[], int]):
        self._policy, self._delay_s, self._expected = policy, delay_s, expected
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="policy")
        self._waiting: list[_Question] = []
        self._arrived = asyncio.Event()

    async def ask(self, observation: dict, instruction: str, history: Any) -> Chunk | PolicyError:
        answer = asyncio.get_running_loop().create_future()
        self._waiting.append(_Question(observation, instruction, history, answer))
        self._arrived.set()
        return await answer

    async def call(self, function: Callable, *args: Any) -> Any:
        """Something else that must not run beside an inference: torch's generators are global."""
        return await asyncio.get_running_loop().run_in_executor(self._thread, function, *args)

    async def run(self) -> None:
        while True:
            await self._arrived.wait()
            until = time.monotonic() + self._delay_s
            while len(self._waiting) < min(self._policy.max_batch, self._expected()):
                self._arrived.clear()
                try:
                    await asyncio.wait_for(self._arrived.wait(), until - time.monotonic())
                except TimeoutError:
                    break
            batch = self._waiting[: self._policy.max_batch]
            del self._waiting[: len(batch)]
            if self._waiting:
                self._arrived.set()
            else:
                self._arrived.clear()
            if batch:
                await self._infer(batch)

    async def _infer(self, waiting: list[_Question]) -> None:
        """Clients may look at different things: only what has the same keys and shapes is one batch."""
        batches: dict[Any, list[_Question]] = {}
        for question in waiting:
            batches.setdefault(self._policy.batch_key(question.observation), []).append(question)
        for batch in batches.values():
            await self._infer_together(batch)

    async def _infer_together(self, batch: list[_Question]) -> None:
        try:
            columns = zip(*((q.observation, q.instruction, q.history) for q in batch), strict=True)
            answers = await self.call(self._policy.act, *map(list, columns))
        except Exception as err:  # whatever it is, it must not end the server
            logger.error("inference failed:\n%s", _trace(err))
            answers = [PolicyError(f"{type(err).__name__}: {err}")] * len(batch)
        for question, answer in zip(batch, answers, strict=True):
            if not question.answer.done():
                question.answer.set_result(answer)

    def close(self) -> None:
        """Waits for the inference under way."""
        self._thread.shutdown()


class PolicyServer:
    """Serves a policy.

    Args:
        policy: what is asked.
        name: of the policy, for clients and the log.
        options: where, and how much.
        identity: of the policy's files and options, for clients.
    """

    def __init__(self, policy: ServedPolicy, name: str, options: ServeOptions, identity: str = ""):
        self._policy, self._options = policy, options
        self._metadata = policy.metadata(name) | ({"identity": identity} if identity else {})
        self._connections = 0
        self._wrong_keys = WrongKeys()
        self.budget = ByteBudget(options.max_pending_bytes)
        self.served = 0
        """Inferences answered."""

    async def run(self, ready: Callable[[int], None], stop: asyncio.Event | None = None) -> None:
        """Serves until `stop` is set, or by default until SIGINT, SIGTERM or SIGHUP.

        Args:
            ready: called with the port once connections are taken.
            stop: ends it.

        Raises:
            RemoteError: the address cannot be used.
        """
        options, tls = self._options, self._options.tls()
        self._batcher = Batcher(self._policy, options.batch_delay_s, lambda: self._connections)

        async def start(seed: int | None, step: int) -> Any:
            return await self._batcher.call(
                self._policy.start, secrets.randbits(63) if seed is None else seed, step
            )

        async def finish(history: Any) -> None:
            await self._batcher.call(self._policy.finish, history)

        self._sessions = Sessions(start, finish, options.max_sessions, self._policy.resumable)
        if stop is None:
            stop = asyncio.Event()
            _stop_on_signals(stop)
        inferring = asyncio.create_task(self._batcher.run())
        self._sockets = OpeningSockets()
        try:
            async with AsyncExitStack() as stack:
                listening = self._sockets.listen(options.host, options.port)
                for one in listening:
                    await stack.enter_async_context(serve(
                        self._handle, sock=one, compression=None, ping_interval=30, ping_timeout=60,
                        max_size=options.max_frame_bytes, max_queue=4, process_request=self._admit,
                        server_header=None, close_timeout=2, ssl=tls, logger=_HANDSHAKES,
                        create_connection=cast(Any, partial(LimitedConnection, budget=self.budget)),
                    ))  # fmt: skip
                ready(listening[0].getsockname()[1])
                await stop.wait()
        except OSError as err:
            raise RemoteError(
                f"cannot listen on {options.host}:{options.port}: {err.strerror or err}. Choose another "
                "--port"
            ) from err
        finally:
            self._sockets.close()
            inferring.cancel()
            self._batcher.close()

    async def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        refusal = self._refusal(request)
        if refusal is not None:
            return connection.respond(*refusal)
        if request.path == "/healthz":
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        key, given = self._options.api_key, request.headers.get_all("Authorization")
        if key is not None and not (
            len(given) == 1
            and secrets.compare_digest(given[0].encode("utf-8", "surrogateescape"), f"Api-Key {key}".encode())
        ):
            await asyncio.sleep(self._wrong_keys.note(str(connection.remote_address[0])))
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, "wrong or missing API key\n")
        if self._connections >= self._options.max_connections:
            logger.warning("refused %s: %d connections", connection.remote_address, self._connections)
            return connection.respond(
                http.HTTPStatus.SERVICE_UNAVAILABLE, "as many connections as --max_connections allows\n"
            )
        return None

    def _refusal(self, request: Request) -> tuple[http.HTTPStatus, str] | None:
        """Pages that a browser has open reach the loopback, too: they say where they come from, or call us by
        a name of their own."""
        if request.headers.get_all("Origin"):
            return http.HTTPStatus.FORBIDDEN, "a policy server takes no requests from web pages\n"
        hosts = request.headers.get_all("Host")
        if is_loopback(self._options.host) and not (len(hosts) == 1 and is_loopback(_bare(hosts[0]))):
            return http.HTTPStatus.FORBIDDEN, "this policy server is called localhost\n"
        return None

    async def _handle(self, socket: ServerConnection) -> None:
        assert isinstance(socket, LimitedConnection)
        self._sockets.finished(socket.transport.get_extra_info("socket").fileno())
        own = f"connection {socket.id}"
        logger.info("%s opened the %s", socket.remote_address, own)
        self._connections += 1
        try:
            await socket.send(pack(self._metadata))
            async for message in socket:
                socket.begin(message)
                try:
                    await socket.send(await self._answer(message, own))
                finally:
                    socket.end()
        except ConnectionClosed as err:
            logger.info("%s lost: %s", own, printable(str(err)))
        finally:
            self._connections -= 1
            await self._sessions.end(own)

    async def _answer(self, message: bytes | str, own: str) -> bytes | str:
        """An answer, or, as openpi does it, an error in words."""
        try:
            if isinstance(message, str):
                raise RequestError("a text frame; requests are binary frames of msgpack")
            # Not in the event loop: a large frame would block the other clients.
            content = await asyncio.to_thread(unpack, message, "the request")
            if not isinstance(content, dict):
                raise RequestError(f"a request is a map, not a {type(content).__name__}")
            envelope = read_envelope(content, own)
            if content.get("reset") is True:
                await self._sessions.end(envelope.session)
                return pack({"reset": True})
            if envelope.end and not any(str(k).startswith("observation.") for k in content):
                await self._sessions.end(envelope.session)
                return pack({"end": True})
            return await self._infer(content, envelope)
        except RemoteError as err:
            logger.warning("%s: %s", own, err)
            return f"{type(err).__name__}: {err}"
        except Exception as err:  # a client's message must not end the server
            logger.error("request failed:\n%s", _trace(err))
            return f"internal error: {type(err).__name__}"

    async def _infer(self, content: dict, envelope: Envelope) -> bytes:
        observation = self._policy.check(content)
        task = content.get("task", content.get("prompt", ""))
        task = task[0] if isinstance(task, list) and len(task) == 1 else task
        if not isinstance(task, str):
            raise RequestError(f"the instruction is {task!r:.100}; give 'task' or 'prompt' as a text")
        session = await self._sessions.get(envelope)
        async with session.busy:
            if envelope.step is not None and envelope.step == session.answered - 1 and session.last:
                return session.last
            if envelope.step is not None and envelope.step != session.answered:
                raise RequestError(
                    f"session {envelope.session!r} is at step {session.answered}, the request says "
                    f"{envelope.step}: two clients with one session?"
                )
            began = time.monotonic()
            chunk = await self._batcher.ask(observation, task, session.history)
            if isinstance(chunk, PolicyError):
                raise RequestError(f"the policy raised: {chunk}")
            self.served += 1
            timing = {"infer_ms": 1000 * (time.monotonic() - began)}
            session.last = pack({"actions": chunk, "server_timing": timing})
            session.answered += 1
        if envelope.end:
            await self._sessions.end(envelope.session)
        return session.last


class _OneLine(logging.Filter):
    """Takes tracebacks off: a handshake that fails is the client's affair."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Shortens a record, and lowers what is no fault of the server."""
        if record.exc_info and record.exc_info[1] is not None:
            err = record.exc_info[1]
            record.msg, record.args = f"{record.getMessage()}: {printable(str(err))[:200]}", ()
            record.exc_info = None
        return True


_HANDSHAKES = logging.getLogger(f"{__name__}.websockets")
_HANDSHAKES.addFilter(_OneLine())


def _trace(err: Exception) -> str:
    """A traceback whose lines may hold a client's words."""
    return "\n".join(printable(line) for line in "".join(traceback.format_exception(err)).splitlines())


def _bare(host: str) -> str:
    """The host of a `PolicyRunner` header, without its port."""
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]


def _stop_on_signals(stop: asyncio.Event) -> None:
    """The first Ctrl-C, SIGTERM or SIGHUP ends the server in good order, the second one at once."""
    loop = asyncio.get_running_loop()
    # Under nohup, SIGHUP is ignored and is to stay so.
    numbers = [n for n in STOP_SIGNALS if n != signal.SIGHUP or signal.getsignal(n) is not signal.SIG_IGN]

    def end(*_: Any) -> None:
        for number in numbers:
            loop.remove_signal_handler(number)
        stop.set()

    for number in numbers:
        loop.add_signal_handler(number, end)
