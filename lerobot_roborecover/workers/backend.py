"""Where worker processes live: on this machine, or on the nodes of a Ray cluster."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.utils.options import internal, option
from lerobot_roborecover.utils.text import install_command
from lerobot_roborecover.workers.messages import SlotFailure

if TYPE_CHECKING:
    from lerobot_roborecover.workers.slots import SlotPool

ENGINES = ("local", "ray")


def refuse_node(failure: SlotFailure | None, where: str) -> None:
    """Raises an `OptionError` where there is a failure."""
    if failure is not None:
        raise OptionError(f"node {where} of the Ray cluster cannot begin: {failure.message}")


@dataclass(frozen=True)
class WorkerStartup:
    """Setup of a cluster slot on its node before its first use, since nodes differ."""

    environment: Callable[[int], Mapping[str, str | None]] | None = None
    """Given the slot's number, environment variables of its process: where it draws. A module's function."""
    first: tuple[str, object] | None = None
    """A command and its argument."""
    check: Callable[[SlotFailure | None, str], None] = refuse_node
    """Told how that went, and on which node; raises what is to end the run."""


@dataclass(frozen=True)
class Backend:
    """Where worker processes live."""

    engine: str = option("local", metavar="local|ray")
    """This machine, or a Ray cluster."""
    address: str = option("auto", name="ray-address", metavar="ADDRESS")
    """The cluster's (this machine's)."""
    prefix: str = internal("--")
    """Prefix of its options' names, for messages."""
    count: str = internal("num_workers")
    """The option that says how many there are."""
    device: str = internal("--device")
    """The option that says where a policy computes."""
    fits: bool = internal(False)
    """Whether fewer than asked for will do: in the middle of a command, which may have lost nodes by then."""

    @property
    def on_cluster(self) -> bool:
        return self.engine == "ray"

    def option(self, name: str) -> str:
        """An option as people write it."""
        return f"{self.prefix}{name.replace('_', '-') if self.prefix == '--' else name}"

    def check(self) -> None:
        """Refuses what cannot be used; imports no Ray.

        Raises:
            OptionError: there is no such engine, or Ray is not installed.
        """
        if self.engine not in ENGINES:
            raise OptionError(f"{self.option('engine')}={self.engine}: not one of {list(ENGINES)}")
        if self.on_cluster and importlib.util.find_spec("ray") is None:
            raise OptionError(
                f"{self.option('engine')}=ray: Ray is not installed. {install_command('ray')}, on every node"
            )

    def allocate_workers(
        self, pool: SlotPool, count: int, here: int, startup: WorkerStartup | None = None
    ) -> int:
        """Has a pool's slots made here.

        Args:
            pool: of worker processes, none of them started.
            count: slots that are asked for; 0 takes what there is room for.
            here: that is, on this machine.
            startup: what they do first, on a cluster.

        Returns:
            How many slots there may be.

        Raises:
            OptionError: there is no such cluster, or it is too small.
        """
        if not self.on_cluster:
            return count or here
        from lerobot_roborecover.workers.cluster import Cluster

        cluster = Cluster(self, pool)
        cluster.make_slots(startup or WorkerStartup())
        return cluster.room(count)


LOCAL = Backend()
