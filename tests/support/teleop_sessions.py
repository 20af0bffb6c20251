"""`roborecover curate teleop` on the fake simulator: a user pushes the puck to its goal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager

import numpy as np

from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.web.serve import listen, make_server
from lerobot_roborecover.web.teleop.client import Client
from lerobot_roborecover.web.teleop.hub import Hub
from lerobot_roborecover.web.teleop.server import TeleopApp, make_app
from lerobot_roborecover.web.teleop.simulator_thread import SimulatorThread
from lerobot_roborecover.web.teleop.store import Store
from tests.support.processes import PATIENCE_S

GOAL = np.array([-0.3, 0.0])


@contextmanager
def driving(out, *more: str, port: int = 0, end: int = signal.SIGKILL):
    """The command as a process; yields it and the page's address. By default it is killed at the end."""
    command = [sys.executable, "-m", "lerobot_roborecover.cli.main", "teleop", str(out), "--platform=fake"]
    command += ["--operator=ann", "--view=32", f"--port={port}", *more]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env={**os.environ, "XDG_STATE_HOME": str(out.parent)},
        # A shell has its background jobs ignore it, and this may be one's child.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    try:
        yield process, process.stdout.readline().split()[-1]
    finally:
        process.send_signal(end)
        process.communicate(timeout=PATIENCE_S)


def push(client: Client, goal=GOAL, limit: int = 400) -> None:
    """Brings the puck to the left goal: around it, behind it, through it."""
    for _ in range(limit):
        if client.status["solved"]:
            return
        bodies = {n: np.array(p[:2]) for n, p in client.state["bodies"].items()}
        hand, puck = bodies["eef"], bodies["puck"]
        away = (puck - goal) / np.linalg.norm(puck - goal)
        side = np.array([-away[1], away[0]])
        along, across = (hand - puck) @ away, (hand - puck) @ side
        if along > 0.05 and abs(across) < 0.02:
            target = puck
        elif along < 0.05:  # around it, out of reach
            target = puck + 0.14 * away + 0.14 * side * (1 if across >= 0 else -1)
        else:
            target = puck + 0.14 * away
        client.act(np.clip((target - hand) * 10, -1, 1))
    raise AssertionError(f"the puck is not at its goal after {limit} steps: {client.state}")


TOKEN = "t" * 32


@contextmanager
def cockpit(folder, starts=(), platform="fake"):
    """Server and simulator in threads of this process; yields the page's address."""
    store, hub = Store(folder), Hub()
    simulation = SimulatorThread(lambda: make_simulator(platform), "ann", starts, store, hub)
    simulation.start()
    simulation.ready.wait()
    listener = listen(0)
    host = f"127.0.0.1:{listener.getsockname()[1]}"
    server = make_server(make_app(TeleopApp(TOKEN, frozenset({host}), hub, simulation.pilot)))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        yield f"http://{host}/drive/?token={TOKEN}"
    finally:
        server.should_exit = True
        thread.join()
        simulation.stop()
        simulation.join()
        store.close()
