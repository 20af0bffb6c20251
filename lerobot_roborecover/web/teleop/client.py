"""Drives a simulator by script, over the same websocket as the page.

with Client("http://127.0.0.1:8732/drive/?token=...") as client:
    client.start("push-v3", seed=3)
    while not client.status["solved"]:
        client.act(expert(client.state["low_dim"]))
    client.finish()
"""

from __future__ import annotations

import json
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.web.teleop.protocol import VERSION, read_picture


class TeleopRefusal(ScenarioError):
    """The server did not do what was asked; the message says why. The connection goes on."""


class Client:
    """One controller, one thing at a time.

    Args:
        address: as `roborecover curate teleop` prints it, with the token.
        pictures: receive images too (`frames`); without them nothing is rendered for this client.
        timeout_s: how long one answer may take; a task's first start compiles it.

    Raises:
        ScenarioError: no server listens there, or the address or its token is not right.
    """

    def __init__(self, address: str, *, pictures: bool = False, timeout_s: float = 300.0):
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        parts = urlsplit(address)
        token = parse_qs(parts.query).get("token", [""])[0]
        url = f"ws://{parts.netloc}{parts.path}socket?token={token}&pictures={int(pictures)}"
        try:
            self._socket = connect(url, proxy=None, max_size=2**26, open_timeout=timeout_s, compression=None)
        except (OSError, WebSocketException, ValueError) as err:
            raise ScenarioError(
                f"{parts.scheme}://{parts.netloc}{parts.path} cannot be driven: {err}. Give the address, "
                "with its token, that `roborecover curate teleop` has printed"
            ) from None
        self._timeout_s = timeout_s
        self._next = 1
        self.status: dict[str, Any] = {}
        """The latest: `step`, `solved`, `mark`, `proven`, `eef_m` and the rest (docs/build.md)."""
        self.state: dict[str, Any] = {}
        """As of the last `start`, `act` or `look`: `bodies` (position and quaternion xyzw, exact) and
        `low_dim` (Meta-World's 39 numbers; None elsewhere)."""
        self.frames: dict[str, bytes] = {}
        """Latest JPEG by camera."""
        self._cameras: list[str] = []
        version = json.loads(self._receive())["version"]
        if version != VERSION:
            raise ScenarioError(f"the server speaks version {version}, this client {VERSION}; upgrade one")
        self.ask("drive")

    # --- what a person does, too

    def start(
        self,
        task: str | int,
        seed: int | None = None,
        *,
        suite: str = "",
        init_state: int | None = None,
        discard: bool = False,
    ) -> dict[str, Any]:
        """Puts a task in its first state.

        Args:
            task: its name; or the number of one of the server's own starts.
            seed: of the reset.
            suite: where several have a task of this name.
            init_state: on LIBERO.
            discard: drop a recording that is under way.

        Returns:
            The status.
        """
        where = {"number": task} if isinstance(task, int) else {"task": task, "suite": suite}
        chosen = {"seed": seed, "init_state": init_state}
        given = {name: value for name, value in chosen.items() if value is not None}
        return self._stateful("start", **where, **given, discard=discard)

    def act(self, actions: np.ndarray | Sequence[float] | Sequence[Sequence[float]]) -> dict[str, Any]:
        """Executes one action (A,), or several (n, A) without looking in between; returns the status.

        Raises:
            TeleopRefusal: one is not finite or not in [-1, 1]; none was executed then.
        """
        rows = np.atleast_2d(np.asarray(actions, dtype=np.float64))
        return self._stateful("act", actions=rows.tolist())

    def back(self, steps: int) -> dict[str, Any]:
        """Takes steps back; returns the status."""
        return self._stateful("back", steps=steps)

    def mark(self, stage: str = "", deviation: str = "") -> dict[str, Any]:
        """Marks this state as the recovery point; returns the status."""
        return self.ask("mark", stage=str(stage), deviation=str(deviation))["status"]

    def finish(self, *, as_dropped: bool = False) -> str:
        """Saves the recording; returns its id. It is on disk then.

        Args:
            as_dropped: save one without a mark, or not solved after it, as dropped.

        Raises:
            TeleopRefusal: it lacks something.
        """
        return self.ask("finish", as_dropped=as_dropped)["saved"]

    def discard(self) -> None:
        """Drops the recording under way."""
        self.ask("discard")

    def look(self) -> dict[str, Any]:
        """Bodies and low-dimensional state now; see `state`."""
        self._stateful("status")
        return self.state

    def hold(self, axes: Sequence[float], *, wait: bool = False) -> None:
        """Holds inputs as a page does; they are let go by themselves unless held again within 0.6 s."""
        self._send({"type": "hold", "axes": list(axes), "wait": wait})

    # --- underneath

    def ask(self, kind: str, **values: Any) -> Mapping[str, Any]:
        """Sends a command and waits for its answer.

        Raises:
            TeleopRefusal: it was refused.
            ScenarioError: the connection broke, or there was no answer in time.
        """
        identity, self._next = self._next, self._next + 1
        self._send({"type": kind, "id": identity, **values})
        while True:
            said = self._receive()
            if isinstance(said, bytes):
                camera, _, jpeg = read_picture(said)
                self.frames[self._cameras[camera]] = jpeg
                continue
            message = json.loads(said)
            if message["type"] == "reply" and message["id"] == identity:
                self.status = message.get("status", self.status)
                if not message["ok"]:
                    raise TeleopRefusal(message["message"])
                return message
            if message["type"] == "cameras":
                self._cameras = message["names"]
            elif message["type"] == "shown":
                self._send({"type": "seen"})

    def _stateful(self, kind: str, **values: Any) -> dict[str, Any]:
        said = self.ask(kind, state=True, **values)
        if "bodies" in said:
            self.state = {"bodies": said["bodies"], "low_dim": said["low_dim"]}
        return self.status

    def _send(self, message: Mapping[str, Any]) -> None:
        with _connection():
            self._socket.send(json.dumps(message))

    def _receive(self) -> str | bytes:
        with _connection():
            try:
                return self._socket.recv(timeout=self._timeout_s)
            except TimeoutError:
                raise ScenarioError(
                    f"the simulator's server did not answer within {self._timeout_s:g} s. {_REMEDY}"
                ) from None

    def close(self) -> None:
        """Ends the connection; a recording under way stays with the server."""
        self._socket.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_REMEDY = "What it had called saved is on its disk; start it again"


@contextmanager
def _connection() -> Generator[None]:
    """One message for a connection that breaks, whether it is noticed in sending or in receiving."""
    from websockets.exceptions import WebSocketException

    try:
        yield
    except (OSError, WebSocketException) as err:
        raise ScenarioError(
            f"the connection to the simulator's server broke ({type(err).__name__}: {err}). {_REMEDY}"
        ) from None
