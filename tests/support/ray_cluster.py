"""A Ray cluster of two nodes on this machine, of which one can be taken away."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from tests.support.processes import PATIENCE_S

SMALL = {"num_cpus": 2, "object_store_memory": 80 * 2**20}
PATIENT = {
    "raylet_start_wait_time_s": PATIENCE_S,
    "gcs_server_request_timeout_seconds": PATIENCE_S,
    "gcs_rpc_server_reconnect_timeout_s": PATIENCE_S,
    "worker_register_timeout_seconds": PATIENCE_S,
    "agent_register_timeout_ms": 1e3 * PATIENCE_S,
    "gcs_server_port_wait_time_s": PATIENCE_S,
}
"""Ray's own limits for what starts and answers, which a busy machine may not keep."""


AGENT_PORTS = (
    "metrics_agent_port",
    "metrics_export_port",
    "dashboard_agent_listen_port",
    "runtime_env_agent_port",
)


def node_arguments() -> dict[str, int]:
    """Of a small node, whose agents have ports that are known beforehand."""
    sockets = [socket.create_server(("", 0)) for _ in AGENT_PORTS]
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return {**SMALL, **dict(zip(AGENT_PORTS, ports, strict=True))}


def tell_ports(node: Any) -> None:
    """Says the ports of a node's agents in their place: it would wait 20 s for them, and die."""
    from ray._raylet import persist_port

    for name in AGENT_PORTS:
        persist_port(node._session_dir, node._node_id, name, getattr(node._ray_params, name))


def descendants(pid: int) -> list[int]:
    """Processes that a process, or one of those, has started."""
    parents = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            parents[int(status.parent.name)] = int(status.read_text().rpartition(")")[2].split()[1])
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found[1:]


class SlowClock:
    """The clock of Ray's code that starts a node, which has a limit of 30 s of its own."""

    def __getattr__(self, name):
        return getattr(time, name)

    def monotonic(self):
        """Seconds, of which a minute is one."""
        return time.monotonic() / 60


class TwoNodes:
    """A head with two CPUs and a second node with two.

    Args:
        cluster: of `ray.cluster_utils`, with its head.
    """

    def __init__(self, cluster):
        self.address = cluster.address
        self._cluster, self._second = cluster, None
        self.lost = 0
        """Second nodes that were taken away."""

    def complete(self) -> TwoNodes:
        """Has the second node there, again."""
        import ray

        if self._second is None:
            self._second = self._cluster.add_node(**node_arguments())
            self._cluster.wait_for_nodes(PATIENCE_S)
            while ray.cluster_resources().get("CPU") != 2 * SMALL["num_cpus"]:
                time.sleep(0.05)
        return self

    def second_has(self, actor: Any) -> bool:
        """Whether an actor that has started is on the second node."""
        from ray._private.state import actors

        return actors(actor._actor_id.hex())["Address"]["NodeID"] == self._second.node_id

    def lose_a_node(self) -> None:
        """Takes the second node away, with everything on it: what its raylet has started would live on for a
        while, and answer."""
        (raylet,) = self._second.all_processes["raylet"]
        there = descendants(raylet.process.pid)
        self._cluster.remove_node(self._second, allow_graceful=False)
        for pid in there:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._second = None
        self.lost += 1


@contextmanager
def two_nodes() -> Generator[TwoNodes]:
    """The cluster, joined by this process."""
    import ray
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        for name, limit in PATIENT.items():
            patch.setenv(f"RAY_{name}", str(int(limit)))
        patch.setattr("ray._private.node.time", SlowClock())
        start = ray._private.node.Node.start_ray_processes
        patch.setattr(
            ray._private.node.Node, "start_ray_processes", lambda node: (tell_ports(node), start(node))
        )
        # Actors import what the tests have of their own.
        patch.setenv("PYTHONPATH", ":".join([str(Path(__file__).parents[2]), *(p for p in sys.path if p)]))
        cluster = Cluster(
            initialize_head=True, head_node_args={**node_arguments(), "include_dashboard": False}
        )
        try:
            ray.init(address=cluster.address, log_to_driver=False)
            yield TwoNodes(cluster).complete()
        finally:
            ray.shutdown()
            cluster.shutdown()
