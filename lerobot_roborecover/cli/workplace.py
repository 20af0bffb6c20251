"""Options of commands whose simulators may be on a Ray cluster."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot_roborecover.workers.backend import Backend


def add_workplace(parser: argparse.ArgumentParser, *, policies: bool) -> None:
    """Adds them.

    Args:
        parser: of the command.
        policies: whether it runs policies.
    """
    add = parser.add_argument
    add("--engine", default="local", metavar="local|ray", help="this machine, or a Ray cluster (%(default)s)")
    add("--ray-address", default="auto", metavar="ADDRESS", help="the cluster's (this machine's)")
    if policies:
        add(
            "--replicas", type=int, default=0, metavar="N",
            help="copies of a policy on the cluster (one per GPU, or one on the CPU)",
        )  # fmt: skip


def workplace(args: argparse.Namespace) -> Backend:
    from lerobot_roborecover.workers.backend import Backend

    return Backend(args.engine, args.ray_address)
