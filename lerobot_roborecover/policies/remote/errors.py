"""Errors between a policy's client and its server; imports nothing."""

from __future__ import annotations

from lerobot_roborecover.errors import RoboRecoverError


def printable(text: str) -> str:
    """Returns text of a peer with control characters, which a terminal obeys, written as escapes."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text
    )


class RemoteError(RoboRecoverError, RuntimeError):
    """A remote policy cannot be asked, or its answer cannot be used.

    What a peer says reaches the user in such errors: their words are made printable here.
    """

    def __init__(self, *words: object):
        super().__init__(*(printable(w) if isinstance(w, str) else w for w in words))


class MappingError(RemoteError):
    """A mapping file cannot be used, or does not fit the observations or the server."""


class WireError(RemoteError):
    """Bytes that the protocol does not allow."""


class ServerUnavailableError(RemoteError):
    """The server does not answer: no connection, a lost one, or a timeout."""


class SessionExpiredError(RemoteError):
    """The server was started again, and with it the trial's history is gone."""


class ServerRefusedError(RemoteError):
    """The server answered with an error in words."""
