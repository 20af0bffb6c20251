"""What a request must bring before it is answered: this server's host, a token, a small body.

The Host header must name this machine, so that a web page elsewhere cannot reach the server through a name
that it points here; a request that changes something, and every websocket that a browser opens, must come
from the page itself.
"""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Mapping
from typing import Any

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import JSONResponse, RedirectResponse, Response

from lerobot_roborecover.web.small_page import POLICY, small_page, wants_page

MAX_BODY_BYTES = 2**14
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self';"
    " img-src 'self' blob: data:; connect-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Refusal(Exception):
    """Refuses a request, with a status and a one-line message for the client."""

    def __init__(self, status: int, message: str):
        super().__init__(message)
        self.status, self.message = status, message


def check_token(request: HTTPConnection, name: str, token: str | None, command: str) -> None:
    """Refuses a request without the token, or from another page.

    Args:
        request: the request, or a websocket that is not accepted yet.
        name: the user's name, which has the token and the cookie.
        token: the right token; None where no user has that name.
        command: the command that has printed the address.

    Raises:
        Refusal: the token is missing or wrong, or a change does not come from the page itself.
    """
    # A wrong name is answered like a wrong token, so that a client cannot find out the users' names.
    cookie = request.cookies.get(cookie_name(name, token or ""), "")
    sent = (cookie, request.query_params.get("token", ""))
    if token is None or not any(hmac.compare_digest(s.encode(), token.encode()) for s in sent):
        raise Refusal(403, f"open the address, with its token, that `{command}` has printed")
    if request.scope["type"] == "websocket" or request.scope["method"] == "POST":
        origin = request.headers.get("origin")
        if origin is not None and origin != f"http://{request.headers.get('host')}":
            raise Refusal(403, "this request does not come from the page")


def with_cookie(request: Request, name: str) -> Response:
    """Exchanges the token in an address for a cookie of that address."""
    token = request.query_params["token"]
    answer = RedirectResponse(f"/{name}/", 303)
    answer.set_cookie(
        cookie_name(name, token),
        token,
        path=f"/{name}/",
        httponly=True,
        samesite="strict",
    )
    return answer


def cookie_name(name: str, token: str) -> str:
    """Name of the cookie that holds a person's token.

    Browsers send a host's cookies to all of its ports: without the token's hash in the name, two servers that
    know the same person would take each other's cookie away.
    """
    return f"roborecover_{name}_{hashlib.sha256(token.encode()).hexdigest()[:12]}"


def guarded(app: Starlette, hosts: frozenset[str]) -> Any:
    """Checks the host of every request, puts the security headers on every answer, errors included, and has a
    browser's address bar answered with a small page where there is none."""

    async def wrapped(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] not in ("http", "websocket"):
            await app(scope, receive, send)
            return
        send_with = _sender(send, wants_page(scope))
        sent = [v.decode("latin-1") for k, v in scope["headers"] if k == b"host"]
        if len(sent) != 1 or sent[0] not in hosts:
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008, "reason": "another host"})
                return
            said = JSONResponse(
                {"error": f"this server is {min(hosts)}; the request names another host"}, 421
            )
            await said(scope, receive, send_with)
            return
        await app(scope, receive, send_with)

    return wrapped


def _sender(send: Any, for_person: bool) -> Any:
    """Sends answers with the security headers; to a person, refusals as small pages."""
    refusal: dict[str, Any] = {}
    parts: list[bytes] = []

    async def send_with(message: Any) -> None:
        if message["type"] == "http.response.start":
            if for_person and message["status"] >= 400:
                refusal.update(message)
                return
            message = {**message, "headers": [*message.get("headers", []), *_raw(_HEADERS)]}
        elif message["type"] == "http.response.body" and refusal:
            parts.append(message.get("body", b""))
            if message.get("more_body"):
                return
            page = small_page(refusal["status"], b"".join(parts))
            about = {"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(page))}
            headers = _raw({**_HEADERS, "Content-Security-Policy": POLICY, **about})
            await send({**refusal, "headers": headers})
            message = {"type": "http.response.body", "body": page}
        await send(message)

    return send_with


def _raw(headers: Mapping[str, str]) -> list[tuple[bytes, bytes]]:
    return [(k.lower().encode(), v.encode()) for k, v in headers.items()]


async def read_body(request: Request) -> dict[str, Any]:
    """The JSON object in a request's body.

    A page elsewhere cannot send one without asking first: that needs this content type.

    Raises:
        Refusal: it is too large, or something else.
    """
    if request.headers.get("content-type", "").partition(";")[0] != "application/json":
        raise Refusal(415, "the body must be application/json")
    data = b""
    try:
        async for part in request.stream():
            data += part
            if len(data) > MAX_BODY_BYTES:
                raise Refusal(413, f"the body has more than {MAX_BODY_BYTES} bytes")
    except ClientDisconnect:
        raise Refusal(400, "the connection was lost") from None
    try:
        sent = json.loads(data, parse_constant=lambda name: name)
    except (ValueError, RecursionError):
        raise Refusal(400, "the body is not JSON") from None
    if not isinstance(sent, dict):
        raise Refusal(400, "the body is not a JSON object")
    return sent
