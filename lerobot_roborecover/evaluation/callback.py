"""Recovery as a curve beside the loss: an evaluation every so many steps of a training loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from lerobot_roborecover.analysis.summary import summarise
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.row import TrialRow


def metrics_of(rows: Sequence[TrialRow]) -> dict[str, float]:
    """Rows of one policy as a flat dict, for a tracker.

    Args:
        rows: of `evaluate`; starts may be mixed.

    Returns:
        By start (`recovery/`, `initial/`, `reversion/`): `success`, in which every scenario weighs the same;
        `success_low` and `success_high`, its 95 % interval, where there are scenarios enough for one;
        `trials`; `invalid`, those of them that count as failures because something broke (where all are,
        there is no rate). From recovery
        points also `macro`, in which every cell that is large enough weighs the same, `macro9` over the
        paper's nine cells, where all are there, and `cell/<cell>`.
    """
    found: dict[str, float] = {}
    for start, part in summarise([asdict(r) for r in rows]).starts.items():
        own: dict[str, float] = {"trials": part.trials, "invalid": sum(part.invalid.values())}
        if part.measured:
            own |= {"success": part.rsr.value, "success_low": part.rsr.low, "success_high": part.rsr.high}
        if start.value == "recovery" and part.measured:
            own |= {"macro": part.macro.value, "macro9": part.macro9.value}
            own |= {f"cell/{cell.cell.replace(' ', '_')}": cell.estimate.value for cell in part.cells}
        found |= {f"{start.value}/{key}": float(value) for key, value in own.items()}
    return {key: value for key, value in found.items() if not math.isnan(value)}


@dataclass
class EvaluationCallback:
    """Call it after every step of a training loop; every `every` steps it evaluates and logs.

    It goes by LeRobot's `--eval_freq`: at steps that `every` divides, and never at step 0.
    """

    scenarios: Any
    """As for `evaluate`."""
    every: int
    """Steps between evaluations."""
    log: Callable[..., Any]
    """Takes `log(metrics, step=step)`: `wandb.log`, a run's `run.log`, `trackio.log`, or a function of your
    own."""
    starts: Sequence[str] = ("recovery",)
    """Where the policy takes over; `("recovery", "initial")` says what a failure to recover is a part of."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of `evaluate`: `env`, `trials`, `seed`, `slots`, ..."""

    def __post_init__(self) -> None:
        if self.every < 1:
            raise OptionError(f"every={self.every}: a number of steps, 1 or more")

    def __call__(self, step: int, policy: Any, processors: tuple[Any, Any] | None = None) -> dict[str, float]:
        """Evaluates if it is time.

        Args:
            step: training steps taken.
            policy: as it is now; comes back as it was.
            processors: its pre- and postprocessor.

        Returns:
            What was logged; empty where it was not time.
        """
        if not step or step % self.every:
            return {}
        from lerobot_roborecover.evaluation.evaluate import evaluate

        options: dict[str, Any] = {"name": f"step {step}", "videos": 0, **self.options}
        options["processors"] = processors
        rows: list[TrialRow] = []
        for start in self.starts:
            options["env"] = {**self.options.get("env", {}), "start": start}
            rows += evaluate(policy, self.scenarios, **options)
        metrics = metrics_of(rows)
        self.log(metrics, step=step)
        return metrics
