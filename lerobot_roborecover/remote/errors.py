"""What goes wrong between a policy's client and its server; imports nothing."""

from __future__ import annotations

from lerobot_roborecover.errors import RoboRecoverError


class RemoteError(RoboRecoverError, RuntimeError):
    """A remote policy cannot be asked, or its answer cannot be used."""


class MappingError(RemoteError):
    """A mapping file cannot be used, or does not fit the observations or the server."""


class WireError(RemoteError):
    """Bytes that the protocol does not allow."""


class ServerAwayError(RemoteError):
    """Nobody answers: no connection, a lost one, or silence."""


class SessionGoneError(RemoteError):
    """The server was started again, and with it the trial's history is gone."""


class ServerRefusedError(RemoteError):
    """The server answered with an error in words."""
