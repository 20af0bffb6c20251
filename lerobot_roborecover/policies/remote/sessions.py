"""Sessions: how a server that keeps histories tells trials apart, whatever connection they come by.

A request may hold an envelope, `{"session": name, "seed": noise seed, "step": requests answered before}`. The
step makes a repeated request harmless: it gets the answer it has had. A session that the server has lost goes
on from its seed and step where the policy keeps nothing else. `"end": true` ends the session, with or without
a last observation. Without an envelope a connection is a session of its own, as openpi's clients expect, and
`{"reset": true}` begins it anew.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from lerobot_roborecover.policies.remote.errors import RemoteError

ENVELOPE = "roborecover"
PROTOCOL = 1


class RequestError(RemoteError):
    """A request that cannot be served; its text goes back to the client."""


class SessionLostError(RequestError):
    """The server knows nothing of a session's earlier requests."""


@dataclass(frozen=True)
class Envelope:
    """Session fields of a request."""

    session: str
    seed: int | None = None
    step: int | None = None
    """None where the client does not count."""
    end: bool = False


def read_envelope(message: dict, default: str) -> Envelope:
    """The envelope of a request.

    Args:
        message: unpacked.
        default: session of a request without one.

    Raises:
        RequestError: it cannot be read.
    """
    content = message.get(ENVELOPE)
    if content is None:
        return Envelope(default)
    known = {"session", "seed", "step", "end"}
    if not isinstance(content, dict) or set(content) - known:
        raise RequestError(f"{ENVELOPE} is {content!r:.200}; it is a map of {sorted(known)}")
    session, seed, step = content.get("session"), content.get("seed"), content.get("step")
    if not isinstance(session, str) or not 1 <= len(session) <= 200:
        raise RequestError(f"{ENVELOPE}.session is {session!r:.60}; it is a text of 1 to 200 characters")
    for name, value in (("seed", seed), ("step", step)):
        if value is not None and (type(value) is not int or not 0 <= value < 2**64):
            raise RequestError(f"{ENVELOPE}.{name} is {value!r:.60}; it is an integer from 0 below 2**64")
    return Envelope(session, seed, step, content.get("end") is True)


@dataclass(eq=False)
class Session:
    """A trial, as the server sees it."""

    history: Any
    answered: int = 0
    last: bytes = b""
    """The last answer, for a client that lost it."""
    busy: asyncio.Lock = field(default_factory=asyncio.Lock)


class Sessions:
    """The open sessions; the one unused for longest gives way when there are too many.

    Args:
        start: makes a history from a noise seed and the requests that it has had.
        finish: gives it back.
        limit: open at once, at most.
        resumable: whether `start` can go on where a session that is lost has been.
    """

    def __init__(
        self,
        start: Callable[[int | None, int], Awaitable[Any]],
        finish: Callable[[Any], Awaitable[None]],
        limit: int,
        resumable: bool = False,
    ):
        self._resumable = resumable
        self._start, self._finish, self._limit = start, finish, limit
        self._open: OrderedDict[str, Session] = OrderedDict()

    def __len__(self) -> int:
        return len(self._open)

    async def get(self, envelope: Envelope) -> Session:
        """The session of a request, opened if it is the first.

        Raises:
            SessionLostError: the session is not known, and has had requests before that matter.
        """
        session = self._open.get(envelope.session)
        if session is None:
            if envelope.step and not (self._resumable and envelope.seed is not None):
                raise SessionLostError(
                    f"session {envelope.session!r} is not open, and had {envelope.step} requests: the server "
                    "was started again, or has more trials at once than --max_sessions"
                )
            while len(self._open) >= self._limit and (idle := self._idle()) is not None:
                await self.end(idle)
            step = envelope.step or 0
            history = await self._start(envelope.seed, step)
            session = self._open.setdefault(envelope.session, Session(history, step))
        self._open.move_to_end(envelope.session)
        return session

    async def end(self, name: str) -> None:
        """Ends a session, if it is open."""
        session = self._open.pop(name, None)
        if session is not None:
            async with session.busy:
                await self._finish(session.history)

    def _idle(self) -> str | None:
        return next((name for name, s in self._open.items() if not s.busy.locked()), None)
