"""A policy's own arithmetic where no variable can choose how it rounds, and its threads on the CPU.

torch takes square roots of float32 from Intel's MKL, which does not round them correctly: on an AMD EPYC
a fifth is off by a bit, whatever `MKL_CBWR` says, and other processors have other errors. Diffusion policies
take roots of their noise schedule in every denoising step. In float64 the error is far below a float32, so
that the rounded root is the same everywhere.
"""

from __future__ import annotations

from typing import Any

import torch

from lerobot_roborecover.workers.capacity import usable_cores

_SCHEDULE = ("alphas_cumprod", "final_alpha_cumprod")
"""What diffusers' schedulers take roots of."""


def make_cross_cpu_deterministic(policy: torch.nn.Module) -> int:
    """Keeps the noise schedules of a policy, and of the policies that it is made of, in float64.

    Its actions then differ from LeRobot's in the last bit, and are the same on every processor as far as
    `utils.determinism.KERNELS` are chosen as well.

    Args:
        policy: a loaded policy; changed in place.

    Returns:
        The number of schedules.
    """
    found: dict[int, Any] = {}
    for part in (policy, *getattr(policy, "policies", ())):
        for module in part.modules():
            for value in vars(module).values():
                if isinstance(getattr(value, _SCHEDULE[0], None), torch.Tensor):
                    found[id(value)] = value
    for scheduler in found.values():
        for name in _SCHEDULE:
            value = getattr(scheduler, name, None)
            if isinstance(value, torch.Tensor):
                setattr(scheduler, name, value.double())
    return len(found)


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
