"""Default number of simulators that a machine runs at once."""

from __future__ import annotations

SLOT_GB = 1.5
"""Memory reckoned for a simulator: a worker that has several tasks compiled, and its first pictures."""


def default_slots(policy_device: str, cores: int, memory_gb: float) -> int:
    """Returns the number of simulators, limited by memory and at least one.

    With a policy on a GPU: two simulators per core, so that one steps during the inference for the other.
    With a policy on the CPU, which needs the cores itself: one simulator per core.

    Args:
        policy_device: torch's name of the policy's device.
        cores: cores that simulators may use.
        memory_gb: memory that simulators may take.
    """
    wanted = cores if policy_device == "cpu" else 2 * cores
    return max(1, min(wanted, int(min(memory_gb, 1e6) / SLOT_GB)))
