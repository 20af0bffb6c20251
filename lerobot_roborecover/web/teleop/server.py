"""The page's server: files, and one websocket that carries inputs one way, status and pictures the other.

Requests are checked as those of `annotate` are (`web/guard.py`); a websocket from another page is
refused by its Origin. Whatever a message holds, the answer is a line that says what is wrong.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.web.guard import Refusal, check_token, guarded, with_cookie
from lerobot_roborecover.web.page import PageFiles
from lerobot_roborecover.web.teleop.hub import Hub, Viewer
from lerobot_roborecover.web.teleop.pilot import InputHandler, OperatorCommand
from lerobot_roborecover.web.teleop.protocol import VERSION, held_axes, parse

NAME = "drive"
"""Of the address and of the cookie."""
_PAGE = PageFiles("lerobot_roborecover.web.teleop", "app.js", "inputs.js", "link.js", "status.js")


@dataclass(frozen=True)
class TeleopApp:
    token: str
    hosts: frozenset[str]
    hub: Hub
    pilot: InputHandler


def make_app(cockpit: TeleopApp) -> Any:
    async def page(request: Request) -> Response:
        check_token(request, NAME, cockpit.token, "roborecover curate teleop")
        if "token" in request.query_params:
            return with_cookie(request, NAME)
        return _PAGE.response(request.path_params.get("file", ""))

    async def refuse(_request: Request, err: Exception) -> Response:
        assert isinstance(err, Refusal)
        return JSONResponse({"error": err.message}, err.status)

    async def home(_request: Request) -> Response:
        return RedirectResponse(f"/{NAME}/", 303)

    async def nowhere(_request: Request) -> Response:
        raise Refusal(404, f"there is no such page; the driving page is /{NAME}/")

    async def socket(websocket: WebSocket) -> None:
        try:
            check_token(websocket, NAME, cockpit.token, "roborecover curate teleop")
        except Refusal as err:
            await websocket.close(1008, err.message)
            return
        await _Connection(websocket, cockpit).run()

    routes = [
        WebSocketRoute(f"/{NAME}/socket", socket),
        Route(f"/{NAME}/", page),
        Route(f"/{NAME}/{{file}}", page),
        Route("/", home),
        Route("/{path:path}", nowhere),
    ]
    app = Starlette(routes=routes, exception_handlers={Refusal: refuse})
    app.router.redirect_slashes = False
    return guarded(app, cockpit.hosts)


class _Connection:
    """One page or script."""

    def __init__(self, websocket: WebSocket, cockpit: TeleopApp):
        self._socket, self._hub, self._pilot = websocket, cockpit.hub, cockpit.pilot
        self._loop = asyncio.get_running_loop()

    async def run(self) -> None:
        await self._socket.accept()
        viewer = self._hub.join(self._socket.query_params.get("pictures") != "0")
        if viewer is None:
            await self._socket.close(1013, "too many pages are open; close one")
            return
        sender = asyncio.create_task(self._send(viewer))
        try:
            await self._socket.send_text(json.dumps({"type": "hello", "version": VERSION}))
            while True:
                message = await self._socket.receive()
                if message["type"] == "websocket.disconnect":
                    return
                text = message.get("text")
                try:
                    if text is None:
                        raise ScenarioError("messages to the server are text")
                    self._take(viewer, parse(text))
                except ScenarioError as err:
                    self._reply(viewer, None, {"ok": False, "message": str(err)})
        except (WebSocketDisconnect, RuntimeError):
            return  # gone in the middle of a message
        finally:
            sender.cancel()
            self._hub.leave(viewer)

    def _take(self, viewer: Viewer, sent: Mapping[str, Any]) -> None:
        kind, identity = sent["type"], sent.get("id")
        if identity is not None and type(identity) is not int:
            raise ScenarioError("id must be a whole number")
        try:
            if kind == "seen":
                self._hub.seen(viewer)
            elif kind == "drive":
                self._hub.drive(viewer)
                self._reply(viewer, identity, {"ok": True})
            elif self._hub.driver is not viewer:
                raise ScenarioError("another page drives, and this page watches; take control first")
            elif kind == "hold":
                device = "gamepad" if sent.get("device") == "gamepad" else "keyboard"
                self._pilot.hold(device, held_axes(dict(sent)), bool(sent.get("wait")))
            else:
                self._pilot.command(OperatorCommand(kind, dict(sent), self._answer_of(viewer, identity)))
        except ScenarioError as err:
            self._reply(viewer, identity, {"ok": False, "message": str(err)})

    def _answer_of(self, viewer: Viewer, identity: int | None) -> Any:
        def answer(said: dict[str, Any]) -> None:
            try:
                self._loop.call_soon_threadsafe(self._reply, viewer, identity, said)
            except RuntimeError:  # the server has ended
                return

        return answer

    def _reply(self, viewer: Viewer, identity: int | None, said: Mapping[str, Any]) -> None:
        viewer.replies.append(json.dumps({"type": "reply", "id": identity, **said}))
        viewer.wake.set()

    async def _send(self, viewer: Viewer) -> None:
        while True:
            await viewer.wake.wait()
            viewer.wake.clear()
            try:
                for message in self._hub.next_messages(viewer):
                    if isinstance(message, bytes):
                        await self._socket.send_bytes(message)
                    else:
                        await self._socket.send_text(message)
            except (WebSocketDisconnect, RuntimeError):
                return
