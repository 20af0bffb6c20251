"""Policy servers for tests: one that answers as openpi's does, and one that runs in a thread."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from lerobot_roborecover.policies.remote.connection import RemoteServer, Request, ServerOptions
from lerobot_roborecover.policies.remote.protocol import pack, unpack
from tests.support.processes import PATIENCE_S

OPENPI_CLIENT = "openpi-client==0.1.2"
VLA_EVAL = "vla-eval==0.8.0"
LAZY_REGISTRY = "lazyregistry==0.4.0"
ROOT = Path(__file__).parents[2]


class OpenpiServer:
    """Sends metadata, answers each request, and at an error sends its traceback and closes: what openpi's
    `websocket_policy_server.py` does at 15a9616.

    Args:
        infer: called with a request and its connection.
    """

    def __init__(self, infer: Callable[[Any, ServerConnection], Any], metadata: Any = None):
        self._infer, self._metadata = infer, {} if metadata is None else metadata
        self.requests: list[Any] = []
        self.connections = 0

    def _handle(self, connection: ServerConnection) -> None:
        self.connections += 1
        try:
            raw = isinstance(self._metadata, str | bytes)
            connection.send(self._metadata if raw else pack(self._metadata))
            for message in connection:
                try:
                    request = unpack(message)
                    self.requests.append(request)
                    answer = self._infer(request, connection)
                    connection.send(answer if isinstance(answer, str | bytes) else pack(answer))
                except ConnectionClosed:
                    raise
                except Exception:
                    connection.send(traceback.format_exc())
                    connection.close(1011, "Internal server error. Traceback included in previous frame.")
                    return
        except ConnectionClosed:
            pass

    @contextmanager
    def running(self) -> Iterator[str]:
        """The server's address, while it runs."""
        with serve(self._handle, "127.0.0.1", 0, compression=None, max_size=None, close_timeout=1) as server:
            thread = threading.Thread(target=server.serve_forever, daemon=True)
            thread.start()
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
            server.shutdown()
            thread.join()


def server_at(url, **options):
    settings = {"timeout_s": PATIENCE_S, "wait_s": 0.3, "reconnect_s": 0.3, "connections": 2, **options}
    return RemoteServer(ServerOptions(url, **settings))


def ask(url, *payloads, **options):
    server = server_at(url, **options)
    try:
        return server.ask([Request(p) for p in payloads])
    finally:
        server.close()


@contextmanager
def serving(policy: Any, **options: Any) -> Iterator[tuple[str, Any]]:
    """A `PolicyServer` in a thread: its address, and itself."""
    import asyncio

    from lerobot_roborecover.policies.remote.server import PolicyServer, ServeOptions

    server = PolicyServer(policy, "test", ServeOptions(port=0, **options))
    loop, up = asyncio.new_event_loop(), threading.Event()
    stop = asyncio.Event()
    address: list[int] = []

    def ready(port: int) -> None:
        address.append(port)
        up.set()

    thread = threading.Thread(target=lambda: loop.run_until_complete(server.run(ready, stop)), daemon=True)
    thread.start()
    assert up.wait(PATIENCE_S)
    try:
        yield f"ws://127.0.0.1:{address[0]}", server
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(PATIENCE_S)
        loop.close()


@pytest.fixture
def standalone(monkeypatch):
    """The modules of `policies/servers`, and a way to run one."""
    monkeypatch.syspath_prepend(str(ROOT / "policies" / "servers"))
    module = importlib.import_module("policy_server")

    def run(infer, **options):
        up, found = threading.Event(), []

        def started(server):
            found.append(server)
            up.set()

        arguments = {"metadata": {"policy": "p"}, "port": 0, "started": started, **options}
        threading.Thread(target=module.serve, args=(infer,), kwargs=arguments, daemon=True).start()
        assert up.wait(PATIENCE_S)
        servers.append(found[0])
        return f"ws://127.0.0.1:{found[0].socket.getsockname()[1]}"

    servers = []
    yield run
    for server in servers:
        server.shutdown()


@pytest.fixture(scope="session")
def openpi_client(tmp_path_factory) -> Any:
    """The real `openpi_client`.

    It pins numpy below 2 and so cannot be a dependency beside LeRobot; its code runs on numpy 2. It is
    installed without dependencies but `typing_extensions`, into a folder of this test session. What the
    environment has itself comes first.
    """
    return _installed("openpi_client", OPENPI_CLIENT, tmp_path_factory)


@pytest.fixture(scope="session")
def vla_eval(tmp_path_factory) -> Any:
    """The real `vla_eval`, likewise: its harness asks for packages that its servers do without."""
    return _installed("vla_eval", VLA_EVAL, tmp_path_factory)


@pytest.fixture(scope="session")
def vla_eval_harness(vla_eval, tmp_path_factory) -> Any:
    """`vla_eval`, with what its orchestrator imports beside LeRobot's packages."""
    _installed("lazyregistry", LAZY_REGISTRY, tmp_path_factory)
    return vla_eval


def _installed(module: str, requirement: str, tmp_path_factory: pytest.TempPathFactory) -> Any:
    if importlib.util.find_spec(module) is None:
        folder = tmp_path_factory.mktemp(module)
        _install(folder, module, requirement)
        sys.path.append(str(folder))
        importlib.invalidate_caches()
    return importlib.import_module(module)


def _uv() -> list[str] | None:
    """A uv that runs, looked for where `scripts/setup.sh` finds or puts it; an environment that uv has made
    has no pip."""
    for command in (["uv"], [str(ROOT / ".tools" / "bin" / "uv")], [sys.executable, "-m", "uv"]):
        with suppress(OSError):
            if subprocess.run([*command, "--version"], capture_output=True, check=False).returncode == 0:
                return command
    return None


def _install(folder: Path, module: str, requirement: str) -> None:
    target = ["--no-deps", "--quiet", "--target", str(folder), requirement, "typing_extensions"]
    commands = [[sys.executable, "-m", "pip", "install", *target]]
    if uv := _uv():
        commands.insert(0, [*uv, "pip", "install", "--python", sys.executable, *target])
    reasons = []
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0 and (folder / module).is_dir():
            return
        reasons.append(done.stderr.strip()[-200:])
    pytest.skip(
        f"{requirement} could not be installed ({'; '.join(reasons)}): run scripts/setup.sh, which finds "
        "or installs uv, and see that PyPI can be reached"
    )
