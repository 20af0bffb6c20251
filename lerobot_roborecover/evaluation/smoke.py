"""Refuses to begin a run whose simulators cannot be made, or cannot draw."""

from __future__ import annotations

from lerobot_roborecover.platforms import SimulatorError
from lerobot_roborecover.workers.messages import SlotFailure


def check_smoke(reply: object, where: str = "") -> None:
    """Looks at a slot's reply to its first command.

    Args:
        reply: to `smoke` or `fingerprint`.
        where: the machine, where there are several.

    Raises:
        SimulatorError: with the remedy.
    """
    if isinstance(reply, SlotFailure):
        place = f" on node {where}" if where else ""
        raise SimulatorError(
            f"the run was not begun, because the first simulator{place} failed: {reply.message}. "
            "'roborecover doctor' checks simulators and OpenGL; MUJOCO_GL=osmesa (of roborecover eval "
            "--runner.render_device=cpu) draws in software, and policies that need no pictures run with "
            "--env.obs_type=state"
        )
