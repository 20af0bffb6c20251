"""RoboRecover for LeRobot: measure, and improve, how robot policies recover from their own deviations.

Importing this package is light: no LeRobot, torch or simulator comes with it. It registers the Gymnasium ids
`roborecover/Libero-v0` and `roborecover/Metaworld-v0`, and pins how simulators round.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lerobot_roborecover.rounding import pin_rounding

pin_rounding()  # before numpy is imported

from lerobot_roborecover.env.registration import register  # noqa: E402

__version__ = "0.1.0"

if TYPE_CHECKING:
    from lerobot_roborecover.datasets import load_scenarios

__all__ = ["__version__", "load_scenarios"]

register()


def __getattr__(name: str) -> Any:
    if name == "load_scenarios":
        from lerobot_roborecover.datasets import load_scenarios

        return load_scenarios
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
