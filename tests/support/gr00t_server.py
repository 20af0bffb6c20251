"""A policy server that answers as GR00T's does, written from its protocol: NVIDIA/Isaac-GR00T@ade260e."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import msgpack
import numpy as np
import zmq

from tests.support.processes import PATIENCE_S


def _array(value: Any) -> Any:
    out = io.BytesIO()
    np.save(out, value, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": out.getvalue()}


def _restored(value: dict) -> Any:
    return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False) if "__ndarray_class__" in value else value


def dumps(message: Any) -> bytes:
    return msgpack.packb(message, default=_array)


def modalities(**parts: tuple[list[str], list[int]]) -> dict[str, Any]:
    """What `get_modality_config` answers: (keys, steps) by modality."""
    return {
        name: {"__ModalityConfig_class__": True, "as_json": {"delta_indices": steps, "modality_keys": keys}}
        for name, (keys, steps) in parts.items()
    }


class Gr00tServer:
    """One REP socket, endpoints by name, errors in words.

    Args:
        infer: actions by name, of an observation; bytes are sent as they are, None ends the server.
        declared: of `get_modality_config`; None: it has no such endpoint.
        token: wanted with every call.
        whole: whether the data of a call are the observation, and the answer the actions (N1.5).
    """

    def __init__(
        self,
        infer: Callable[[dict], Mapping[str, Any] | bytes | None],
        declared: Mapping[str, Any] | None = None,
        token: str | None = None,
        whole: bool = False,
    ):
        self._infer, self._declared, self._token, self._whole = infer, declared, token, whole
        self.calls: list[tuple[str, Any]] = []

    def _answer(self, call: dict) -> Any:
        if self._token is not None and call.get("api_token") != self._token:
            return {"error": "Unauthorized: Invalid API token"}
        endpoint, data = call.get("endpoint", "get_action"), call.get("data", {})
        self.calls.append((endpoint, data))
        if endpoint == "ping":
            return {"status": "ok", "message": "Server is running"}
        if endpoint == "get_modality_config" and self._declared is not None:
            return self._declared
        if endpoint == "reset":
            return {}
        if endpoint != "get_action":
            raise ValueError(f"Unknown endpoint: {endpoint}")
        if not self._whole:
            assert set(data) <= {"observation", "options"}
        actions = self._infer(data if self._whole else data["observation"])
        return actions if self._whole or actions is None or isinstance(actions, bytes) else [actions, {}]

    @contextmanager
    def running(self, address: str = "tcp://127.0.0.1:*") -> Iterator[str]:
        """The server's address, while it runs."""
        context = zmq.Context()
        socket = context.socket(zmq.REP)
        socket.setsockopt(zmq.LINGER, 0)
        socket.bind(address)
        done = threading.Event()

        def serve() -> None:
            while not done.is_set():
                if not socket.poll(20):
                    continue
                try:
                    answer = self._answer(msgpack.unpackb(socket.recv(), object_hook=_restored))
                except Exception as err:
                    answer = {"error": str(err)}
                if answer is None:
                    break
                socket.send(answer if isinstance(answer, bytes) else dumps(answer))
            socket.close(0)

        thread = threading.Thread(target=serve, daemon=True)
        url = socket.getsockopt_string(zmq.LAST_ENDPOINT)
        thread.start()
        try:
            yield url
        finally:
            done.set()
            thread.join(PATIENCE_S)
            context.term()
