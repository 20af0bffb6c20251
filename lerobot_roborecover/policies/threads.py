"""Threads of a policy that runs on the CPU."""

from __future__ import annotations

import torch

from lerobot_roborecover.workers.capacity import usable_cores


def fit_threads(device: object) -> None:
    """Gives torch no more threads than there are cores for them.

    Torch counts the machine's cores. In a container that may use two of 64, the kernel would stop all 64
    threads for most of every period.

    Args:
        device: of the policy; nothing changes unless it is the CPU.
    """
    cores = usable_cores()
    if str(device) == "cpu" and torch.get_num_threads() > cores:
        torch.set_num_threads(cores)
