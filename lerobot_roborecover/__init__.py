"""RoboRecover for LeRobot: measure, and improve, how robot policies recover from their own deviations.

Importing this package is light: no LeRobot, torch or simulator comes with it. It registers the Gymnasium ids
`roborecover/<Platform>-v0`, such as `roborecover/Libero-v0`, and pins how simulators round.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from lerobot_roborecover.rounding import pin_rounding

pin_rounding()  # before numpy is imported

from lerobot_roborecover.env.registration import register  # noqa: E402

__version__ = "0.1.0"

if TYPE_CHECKING:
    from lerobot_roborecover.analysis.make import report
    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.env.trial_row import TrialRow
    from lerobot_roborecover.platforms import Platform
    from lerobot_roborecover.scenario import Rollout, Scenario
    from lerobot_roborecover.trials.evaluation import evaluate
    from lerobot_roborecover.trials.training import EvaluationCallback, metrics_of

__all__ = [
    "EvaluationCallback",
    "Platform",
    "Rollout",
    "Scenario",
    "TrialRow",
    "__version__",
    "evaluate",
    "load_scenarios",
    "metrics_of",
    "report",
]

_WHERE = {
    "EvaluationCallback": "trials.training",
    "Platform": "platforms",
    "Rollout": "scenario",
    "Scenario": "scenario",
    "TrialRow": "env.trial_row",
    "evaluate": "trials.evaluation",
    "load_scenarios": "datasets",
    "metrics_of": "trials.training",
    "report": "analysis.make",
}
"""Module of each name that is imported when it is asked for."""

register()


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        return getattr(importlib.import_module(f"{__name__}.{_WHERE[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
