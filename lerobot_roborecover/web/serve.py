"""A server on this machine's loopback alone, and tokens that are kept for the next start, so that a page that
was open before goes on where it was."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_file

HOST = "127.0.0.1"
MAX_SOCKET_MESSAGE_BYTES = 2**16
"""Of one websocket message to the server; a larger one ends the connection."""


def listen(port: int, host: str = HOST) -> socket.socket:
    """A socket, by default on this machine alone.

    Args:
        port: 0 takes a free one.
        host: address that it is bound to.

    Raises:
        ScenarioError: the port is taken, or none, or the address is not this machine's.
    """
    # With the protocol named, asyncio turns Nagle's algorithm off: small answers wait for nothing.
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        # A client that connects before the server is ready waits, instead of being refused.
        listener.listen(128)
    except (OSError, OverflowError) as err:
        listener.close()
        raise ScenarioError(
            f"{host}:{port} cannot be served: {err}. Name another port, or 0 for a free one"
        ) from None
    return listener


def own_hosts(port: int) -> frozenset[str]:
    """Host headers that name a server of this machine."""
    return frozenset({f"{HOST}:{port}", f"localhost:{port}"})


def kept_tokens(kind: str, folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Each person's token, made once for each folder; kept outside the dataset, which may be published.

    Args:
        kind: the command, e.g. `annotate`.
        folder: what the tokens are for.
        names: who needs one.
    """
    base = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "roborecover"
    base.mkdir(parents=True, exist_ok=True)
    path = base / f"{kind}-{hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16]}.json"
    try:
        known = {str(k): str(v) for k, v in json.loads(path.read_text("utf-8")).items()}
    except (OSError, ValueError, AttributeError):
        known = {}
    for name in names:
        if len(known.get(name, "")) < 20:
            known[name] = secrets.token_urlsafe(24)
    with atomic_file(path) as temporary:
        private = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with open(private, "w", encoding="utf-8") as file:
            json.dump(known, file)
    return {name: known[name] for name in names}


def make_server(app: Any, certificate: Path | None = None, key: Path | None = None) -> Any:
    """A uvicorn server of an application; `server.run(sockets=[listener])` runs it until interrupted.

    Args:
        app: of ASGI.
        certificate: PEM file, for TLS.
        key: of the certificate.
    """
    import uvicorn

    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=2,
        ws="websockets-sansio",
        ws_max_size=MAX_SOCKET_MESSAGE_BYTES,
        lifespan="off",
        ssl_certfile=certificate,
        ssl_keyfile=key,
    )
    # Imported here, not in the server's thread: modules of websockets import each other in a circle, and two
    # threads that begin in different places wait for each other (DeadlockError).
    config.load()
    return uvicorn.Server(config)
