"""Serves the console to a phone: one at a time, let in by a one-time code that the terminal shows.

On a lab's own network the server listens on every address (`--host 0.0.0.0`), so that a phone reaches it. A
page elsewhere cannot use it: requests must name one of the server's addresses, and changes must come from the
page itself. With `tls` the traffic is encrypted; without, it can be read by others on the network.
"""

from __future__ import annotations

import hmac
import io
import secrets
import socket
import ssl
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import Route

from lerobot_roborecover.robot.console import Console
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.web.guard import Refusal, guarded, read_body
from lerobot_roborecover.web.page import PageFiles
from lerobot_roborecover.web.serve import listen, make_server

COOKIE = "roborecover_console"
MAX_TRIES = 5
_LAST_LOOK_S = 1.5
"""The page asks twice a second."""
VIEWS = ("blend", "difference", "edges", "recorded", "live")
_PAGE = PageFiles("lerobot_roborecover.robot.phone", "app.js")


class Door:
    """Lets one phone in at a time.

    Args:
        say: takes the code, for the terminal.
    """

    def __init__(self, say: Callable[[str], None]):
        self._say, self._lock = say, threading.Lock()
        self._token, self._tries = "", 0
        self._new_code("code for the phone")

    def _new_code(self, what: str) -> None:
        self.code, self._tries = f"{secrets.randbelow(10**6):06d}", 0
        self._say(f"{what}: {self.code}")

    def enter(self, code: str, take_over: bool) -> str:
        """Exchanges a code for a token.

        Args:
            code: as typed.
            take_over: put another phone out that is in.

        Raises:
            Refusal: the code is wrong, or another phone is in.
        """
        with self._lock:
            if not hmac.compare_digest(code.encode(), self.code.encode()):
                self._tries += 1
                if self._tries >= MAX_TRIES:
                    self._new_code(f"{MAX_TRIES} wrong codes were typed; from now on it is")
                raise Refusal(403, "this is not the code that the terminal shows")
            if self._token and not take_over:
                raise Refusal(409, "another phone is the console; take over, or use that one")
            self._token = secrets.token_urlsafe(24)
            self._new_code("a phone is in; the code for another one, should it take over")
            return self._token

    def check(self, token: str) -> None:
        """Refuses a token that is not the present phone's.

        Raises:
            Refusal: it is none, or another phone has taken over.
        """
        if not self._token or not hmac.compare_digest(token.encode(), self._token.encode()):
            raise Refusal(
                403,
                "this phone is not let in: the program was started again, or another phone has taken over. "
                "Type the code that the terminal shows",
            )

    def leave(self) -> None:
        """Lets the present phone out."""
        self._token = ""


@dataclass(frozen=True)
class PhoneConfig:
    """Where the page is served."""

    host: str = "127.0.0.1"
    """`0.0.0.0` lets a phone on the same network in."""
    port: int = 8734
    """0 takes a free one."""
    tls_certificate: Path | None = None
    """PEM file; with its key, the page is served as https."""
    tls_key: Path | None = None


def make_app(console: Console, door: Door, hosts: frozenset[str], scheme: str = "http") -> Any:
    """The application.

    Args:
        console: what is served.
        door: who is let in.
        hosts: Host headers that name this server.
        scheme: `http` or `https`.
    """

    def inside(request: Request) -> None:
        door.check(request.cookies.get(COOKIE, ""))
        origin = request.headers.get("origin")
        if request.method == "POST" and origin not in (None, f"{scheme}://{request.headers.get('host')}"):
            raise Refusal(403, "this request does not come from the page")
        console.heard()

    async def page(request: Request) -> Response:
        return _PAGE.response(request.path_params.get("file", ""))

    async def enter(request: Request) -> Response:
        sent = await read_body(request)
        token = door.enter(str(sent.get("code", "")), sent.get("take_over") is True)
        console.heard()
        answer = JSONResponse({"inside": True})
        answer.set_cookie(COOKIE, token, httponly=True, samesite="strict", secure=scheme == "https")
        return answer

    async def state(request: Request) -> Response:
        inside(request)
        found = console.state()
        details = {k: v for k, v in found["details"].items() if k != "truth"}
        return JSONResponse({**found, "details": details})

    async def press(request: Request) -> Response:
        inside(request)
        sent = await read_body(request)
        values = {k: str(v) for k, v in sent.items() if k in ("reason", "note")}
        # A second tap on a button must not answer the next screen's question.
        if not console.press(str(sent.get("button", "")), values, _screen_of(sent)):
            raise Refusal(409, "this button is not on the present screen any more")
        return JSONResponse({"taken": True})

    async def leave(request: Request) -> Response:
        inside(request)
        door.leave()
        console.leave()
        return JSONResponse({"inside": False})

    async def ghost(request: Request) -> Response:
        inside(request)
        pair = console.pictures.get(request.path_params["camera"])
        view = request.path_params["view"]
        if view not in VIEWS:
            raise Refusal(404, f"there is no view {view!r:.40}")
        if pair is None:  # of a screen that has gone since the page asked what to show
            return Response(status_code=204)
        data = await run_in_threadpool(_jpeg, pair, view)
        return Response(data, media_type="image/jpeg")

    async def refuse(_request: Request, err: Exception) -> Response:
        assert isinstance(err, Refusal)
        return JSONResponse({"error": err.message}, err.status)

    async def home(_request: Request) -> Response:
        return RedirectResponse("/console/", 303)

    routes = [
        Route("/", home),
        Route("/console/", page),
        Route("/console/api/enter", enter, methods=["POST"]),
        Route("/console/api/state", state),
        Route("/console/api/press", press, methods=["POST"]),
        Route("/console/api/leave", leave, methods=["POST"]),
        Route("/console/api/ghost/{camera}/{view}", ghost),
        Route("/console/{file}", page),
    ]
    app = Starlette(routes=routes, exception_handlers={Refusal: refuse})
    app.router.redirect_slashes = False
    return guarded(app, hosts)


def _screen_of(sent: dict[str, Any]) -> int:
    """Version of the screen that was pressed on; of none where the request does not say it."""
    version = sent.get("version")
    return version if type(version) is int else -1


class Phone:
    """Serves a console in a thread until it is closed.

    Args:
        console: what is served.
        config: where.
        say: takes the address and the code.

    Raises:
        ScenarioError: the port is taken, or the certificate cannot be used.
    """

    def __init__(self, console: Console, config: PhoneConfig, say: Callable[[str], None] = print):
        self._console = console
        _check_pair(config.tls_certificate, config.tls_key)
        self._listener = listen(config.port, config.host)
        port = self._listener.getsockname()[1]
        scheme = "https" if config.tls_certificate else "http"
        names = {config.host, "127.0.0.1", "localhost"}
        if config.host == "0.0.0.0":
            names |= {_own_address(), socket.gethostname()}
        names.discard("0.0.0.0")
        hosts = frozenset(f"{name}:{port}" for name in names)
        shown = _own_address() if config.host == "0.0.0.0" else config.host
        self.address = f"{scheme}://{shown}:{port}/console/"
        say(f"console: {self.address}")
        self.door = Door(say)
        app = make_app(console, self.door, hosts, scheme)
        self._server = make_server(app, config.tls_certificate, config.tls_key)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._listener]}, daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Ends the server, once a phone that is in has seen the last screen."""
        if self._console.phone_in:
            time.sleep(_LAST_LOOK_S)
        self._server.should_exit = True
        self._thread.join(5.0)
        self._listener.close()


def _jpeg(pair: tuple[np.ndarray, np.ndarray], view: str) -> bytes:
    from PIL import Image

    from lerobot_roborecover.robot.vision import ghost

    buffer = io.BytesIO()
    Image.fromarray(ghost(*pair, view)).save(buffer, "JPEG", quality=90)
    return buffer.getvalue()


def _check_pair(certificate: Path | None, key: Path | None) -> None:
    """Refuses what is no certificate with its key, before anything is served."""
    if certificate is None and key is None:
        return
    if certificate is None or key is None:
        raise ScenarioError("--tls_certificate, --tls_key: https takes both, a certificate and its key")
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
    except (OSError, ValueError) as err:
        raise ScenarioError(
            f"--tls_certificate={certificate}, --tls_key={key}: no certificate and its key in PEM ({err})"
        ) from None


def _own_address() -> str:
    """This machine's address on its network; nothing is sent."""
    probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        probe.connect(("192.0.2.1", 9))
        return str(probe.getsockname()[0])
    except OSError:
        return "127.0.0.1"
    finally:
        probe.close()
