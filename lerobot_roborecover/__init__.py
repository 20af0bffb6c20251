"""RoboRecover for LeRobot: measure, and improve, how robot policies recover from their own deviations.

Importing this package is light: no LeRobot, torch, numpy or simulator comes with it. It registers the
Gymnasium ids `roborecover/<Platform>-v0`, such as `roborecover/Libero-v0`, when Gymnasium is imported, and
pins how simulators round.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from lerobot_roborecover.utils.determinism import pin_blas_kernels

pin_blas_kernels()  # before numpy is imported

from lerobot_roborecover._version import __version__  # noqa: E402
from lerobot_roborecover.workers.registration import register_with_gymnasium  # noqa: E402

if TYPE_CHECKING:
    from lerobot_roborecover.analysis.make import report
    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.evaluation.evaluate import EvaluationCallback, evaluate, metrics_of
    from lerobot_roborecover.logs.row import TrialRow
    from lerobot_roborecover.platforms import Platform
    from lerobot_roborecover.scenario import Rollout, Scenario

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
    "EvaluationCallback": "evaluation.evaluate",
    "Platform": "platforms",
    "Rollout": "scenario",
    "Scenario": "scenario",
    "TrialRow": "logs.row",
    "evaluate": "evaluation.evaluate",
    "load_scenarios": "datasets",
    "metrics_of": "evaluation.evaluate",
    "report": "analysis.make",
}
"""Module of each name that is imported when it is asked for."""

register_with_gymnasium()


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        return getattr(importlib.import_module(f"{__name__}.{_WHERE[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
