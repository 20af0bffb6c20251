"""Limits that a policy server holds over all of its clients together: bytes under way, and wrong keys."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.frames import DATA_OPCODES, Frame

logger = logging.getLogger(__name__)

SHARE_BYTES = 2**20
"""What any connection may always send, whatever the others do."""
RECEIVE_TIMEOUT_S = 120.0
"""For a request larger than that, from its first byte to its last."""
FIRST_DELAY_S, LONGEST_DELAY_S = 0.1, 5.0
"""Before the answer to a wrong key; doubled with every further one from the same address."""
_MAX_ADDRESSES = 4096
_FORGET_S = 600.0


class ByteBudget:
    """Bytes of requests that have arrived, in part or whole, and are not answered yet.

    Over the limit the server stops reading from connections that hold more than `SHARE_BYTES`, except from
    the one that began first, so that one request after the other can be completed.

    Args:
        limit: of all connections together.
    """

    def __init__(self, limit: int):
        self._limit = limit
        self._held: dict[LimitedConnection, int] = {}
        self._paused: dict[LimitedConnection, None] = {}

    @property
    def held(self) -> int:
        """Bytes that all connections hold."""
        return sum(self._held.values())

    def update(self, connection: LimitedConnection, size: int) -> None:
        """Notes what a connection holds now, and pauses or resumes reading.

        Args:
            connection: whose bytes they are.
            size: 0 takes it off the list.
        """
        before = self._held.get(connection, 0)
        if size:
            self._held[connection] = size
        else:
            self._held.pop(connection, None)
        if size > before and not self._may_read(connection):
            self._paused[connection] = None
            connection.transport.pause_reading()
        if size < before:
            for waiting in list(self._paused):
                if self._may_read(waiting):
                    del self._paused[waiting]
                    waiting.resume()

    def drop(self, connection: LimitedConnection) -> None:
        """Forgets a connection that is closed."""
        self._paused.pop(connection, None)
        self.update(connection, 0)

    def is_paused(self, connection: LimitedConnection) -> bool:
        """Returns whether a connection is not read from because of the others."""
        return connection in self._paused

    def _may_read(self, connection: LimitedConnection) -> bool:
        if self._held.get(connection, 0) <= SHARE_BYTES or self.held <= self._limit:
            return True
        return connection is next(c for c, size in self._held.items() if size > SHARE_BYTES)


class LimitedConnection(ServerConnection):
    """A connection that reports its bytes to a `ByteBudget`: partial frames, waiting frames, and the request
    under way."""

    def __init__(self, *args: Any, budget: ByteBudget, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._budget = budget
        self._partial = self._queued = self._working = 0
        self._deadline: asyncio.TimerHandle | None = None

    def data_received(self, data: bytes) -> None:
        """Feeds incoming bytes to the protocol; see `asyncio.Protocol`."""
        self._partial += len(data)
        super().data_received(data)
        self._report()
        large = self._partial + self._queued > SHARE_BYTES and not self._working
        if large and self._deadline is None:
            self._start_deadline()

    def process_event(self, event: Any) -> None:
        """Takes a frame, or the handshake's request, off what has arrived."""
        if isinstance(event, Frame):
            size = len(event.data)
            header = 6 + (0 if size < 126 else 2 if size < 2**16 else 8)
            self._partial = max(0, self._partial - header - size)
            self._queued += size if event.opcode in DATA_OPCODES else 0
        else:
            self._partial = 0
        super().process_event(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Gives back what the connection held; see `asyncio.Protocol`."""
        super().connection_lost(exc)
        self._stop_deadline()
        self._budget.drop(self)

    def begin(self, message: bytes | str) -> None:
        """Called when a request has been taken off the queue.

        Args:
            message: the request.
        """
        self._stop_deadline()
        self._working = len(message.encode() if isinstance(message, str) else message)
        self._queued = max(0, self._queued - self._working)

    def resume(self) -> None:
        """Reads on after a pause, which does not count against the connection's time."""
        if self._deadline is not None:
            self._stop_deadline()
            self._start_deadline()
        self.transport.resume_reading()

    def end(self) -> None:
        """Called when the request is answered."""
        self._working = 0
        self._report()

    def _report(self) -> None:
        if self.transport.is_closing():
            return
        self._budget.update(self, self._partial + self._queued + self._working)

    def _expire(self) -> None:
        self._deadline = None
        if self._working:
            return
        if self._budget.is_paused(self):
            self._start_deadline()
            return
        logger.warning(
            "connection %s closed: its request of more than %d bytes did not arrive within %g s", self.id,
            SHARE_BYTES, RECEIVE_TIMEOUT_S,
        )  # fmt: skip
        self.transport.abort()

    def _start_deadline(self) -> None:
        self._deadline = self.loop.call_later(RECEIVE_TIMEOUT_S, self._expire)

    def _stop_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


class WrongKeys:
    """Wrong keys by address: each further one is answered later, and logged ever more rarely."""

    def __init__(self, now: Callable[[], float] = time.monotonic):
        self._now = now
        self._seen: OrderedDict[str, tuple[int, float]] = OrderedDict()

    def note(self, address: str) -> float:
        """Notes a wrong key.

        Args:
            address: the client's.

        Returns:
            How many seconds to wait with the answer.
        """
        count, at = self._seen.pop(address, (0, 0.0))
        count = count + 1 if self._now() - at < _FORGET_S else 1
        self._seen[address] = (count, self._now())
        if len(self._seen) > _MAX_ADDRESSES:
            self._seen.popitem(last=False)
        if count & (count - 1) == 0:
            logger.warning("wrong or missing API key from %s, %d so far; answers are slowed", address, count)
        return min(FIRST_DELAY_S * 2 ** min(count - 1, 30), LONGEST_DELAY_S)
