"""Human takeover: the interface between the composite policy and a person, or a script in their place.

`--policy.mode=human --policy.controller=package.module:function` calls `function()` once. What it returns
controls every slot that is handed over, one action at a time, until it hands the slot back. Then, or when the
trial ends, the base policy continues with fresh history.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from lerobot_roborecover.errors import OptionError

if TYPE_CHECKING:
    import torch


@runtime_checkable
class TakeoverController(Protocol):
    """Controls slots. A call may take as long as a person needs: only this trial's simulator waits, and
    those that are due for the policy."""

    def take(self, instruction: str) -> Any:
        """Takes a slot over; what it returns stands for the slot in the calls that follow.

        Args:
            instruction: of its task.
        """

    def act(self, slot: Any, observation: Mapping[str, torch.Tensor]) -> np.ndarray | None:
        """Next action, (A,) in the environment's own units; None hands the slot back to the base policy.

        Args:
            slot: what `take` returned.
            observation: LeRobot keys without a batch axis, as after the env preprocessor: pictures
                (3, H, W) float32 in [0, 1].
        """

    def leave(self, slot: Any) -> None:
        """The slot is no longer the driver's: handed back, or its trial is over."""


_MOVED = dict.fromkeys(
    ("lerobot_roborecover.build.teleop.takeover", "lerobot_roborecover.studio.teleop.takeover"),
    "lerobot_roborecover.web.teleop.takeover",
)
"""Controllers under the names that they once had, which saved configurations may hold."""


def load_controller(name: str) -> TakeoverController:
    """The controller that an option names.

    Args:
        name: `package.module:function`.

    Raises:
        OptionError: there is no such function, or what it returns is no controller.
    """
    module_name, _, function = name.partition(":")
    module_name = _MOVED.get(module_name, module_name)
    try:
        made = getattr(importlib.import_module(module_name), function)()
    except (ImportError, AttributeError, ValueError) as err:
        raise OptionError(
            f"--policy.controller={name}: cannot be made ({err}). Give package.module:function, "
            "importable from where this runs"
        ) from err
    if not isinstance(made, TakeoverController):
        raise OptionError(
            f"--policy.controller={name}: gave a {type(made).__name__}, which lacks `take`, `act` or `leave` "
            "(lerobot_roborecover.policies.interventions.takeover)"
        )
    return made
