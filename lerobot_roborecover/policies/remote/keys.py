"""The secret that a policy server and its clients share; imports nothing heavy."""

from __future__ import annotations

import os

from lerobot_roborecover.policies.remote.errors import RemoteError

API_KEY = "ROBORECOVER_API_KEY"
"""Environment variable, on both machines."""


MIN_KEY_CHARS = 16
"""Of a server's key: shorter ones can be found by trying."""


def check_key(key: str) -> None:
    """Checks that a key is long enough for a server that a network reaches.

    Raises:
        RemoteError: it is too short.
    """
    if len(key) < MIN_KEY_CHARS:
        raise RemoteError(
            f"{API_KEY} has {len(key)} characters; a server's key has {MIN_KEY_CHARS} or more. Make one: "
            "openssl rand -hex 16"
        )


def api_key() -> str | None:
    """The key of this process; None where none is set.

    Raises:
        RemoteError: it is set, and is empty or nothing that a header can carry.
    """
    key = os.environ.get(API_KEY)
    if key is None:
        return None
    if not key.strip():
        raise RemoteError(
            f"{API_KEY} is set and empty, which would admit every client: give it a value, or unset it"
        )
    if key != key.strip() or not key.isascii() or not key.isprintable():
        raise RemoteError(f"{API_KEY} holds spaces at its ends, or what is not printable ASCII")
    return key
