"""How many simulators a machine runs at once where nobody says."""

from __future__ import annotations

SLOT_GB = 1.5
"""Memory reckoned for a simulator: a worker that has several tasks compiled, and its first pictures."""


def default_slots(policy_device: str, cores: int, memory_gb: float) -> int:
    """Two simulators a core under a policy on a GPU, so that one steps while the other is inferred for; one a
    core under a policy on the CPU, which needs the cores itself. As many as memory allows, and one at least.

    Args:
        policy_device: torch's name of it.
        cores: that simulators may use.
        memory_gb: that they may take.
    """
    wanted = cores if policy_device == "cpu" else 2 * cores
    return max(1, min(wanted, int(min(memory_gb, 1e6) / SLOT_GB)))
