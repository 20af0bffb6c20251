"""What a request must bring before it is answered: this server's host, a token, a small body.

The Host header must name this machine, so that a web page elsewhere cannot reach the server through a name
that it points here; a request that changes something, and every websocket that a browser opens, must come
from the page itself.
"""

from __future__ import annotations

import hmac
import json
from typing import Any

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import JSONResponse, RedirectResponse, Response

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
    """A request is not answered; carries the status and one line for whoever sent it."""

    def __init__(self, status: int, message: str):
        super().__init__(message)
        self.status, self.message = status, message


def check_token(request: HTTPConnection, name: str, token: str | None, command: str) -> None:
    """Refuses a request without the token, or from another page.

    Args:
        request: or a websocket that is not accepted yet.
        name: whose token, and whose cookie.
        token: the right one; None where nobody has that name.
        command: has printed the address.

    Raises:
        Refusal: the token is missing or wrong, or a change does not come from the page itself.
    """
    sent = (request.cookies.get(cookie_name(name), ""), request.query_params.get("token", ""))
    # A wrong name is answered like a wrong token: nobody learns here who else takes part.
    if token is None or not any(hmac.compare_digest(s.encode(), token.encode()) for s in sent):
        raise Refusal(403, f"open the address, with its token, that `{command}` has printed")
    if request.scope["type"] == "websocket" or request.scope["method"] == "POST":
        origin = request.headers.get("origin")
        if origin is not None and origin != f"http://{request.headers.get('host')}":
            raise Refusal(403, "this request does not come from the page")


def with_cookie(request: Request, name: str) -> Response:
    """Exchanges the token in an address for a cookie of that address."""
    answer = RedirectResponse(f"/{name}/", 303)
    answer.set_cookie(
        cookie_name(name),
        request.query_params["token"],
        path=f"/{name}/",
        httponly=True,
        samesite="strict",
    )
    return answer


def cookie_name(name: str) -> str:
    """Name of the cookie that holds a person's token."""
    return f"roborecover_{name}"


def guarded(app: Starlette, hosts: frozenset[str]) -> Any:
    """Checks the host of every request, and puts the security headers on every answer, errors included."""

    async def wrapped(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] not in ("http", "websocket"):
            await app(scope, receive, send)
            return

        async def send_with(message: Any) -> None:
            if message["type"] == "http.response.start":
                extra = [(k.lower().encode(), v.encode()) for k, v in _HEADERS.items()]
                message = {**message, "headers": [*message.get("headers", []), *extra]}
            await send(message)

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
