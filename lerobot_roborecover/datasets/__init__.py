"""Scenario datasets: read, write, select, and pull from the Hub.

Importing this package is light: pyarrow, LeRobot and huggingface_hub come in with the first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lerobot_roborecover.datasets.load import ScenarioSet, load_scenarios, validate_for
    from lerobot_roborecover.datasets.read import read_scenarios
    from lerobot_roborecover.datasets.write import write_scenarios

_EXPORTS = {
    "ScenarioSet": "load",
    "load_scenarios": "load",
    "read_scenarios": "read",
    "validate_for": "select",
    "write_scenarios": "write",
}

__all__ = ["ScenarioSet", "load_scenarios", "read_scenarios", "validate_for", "write_scenarios"]


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
