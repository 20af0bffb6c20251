"""What a second rater said of a robot's recorded trials, and how well it goes with the first verdicts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lerobot_roborecover.logs.log_file import TRIALS_FILE
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.journal import read_journal

FOLDER = "ratings"
"""Beside the trial log: a journal a rater."""
SCHEMA = 1


def recorded(run: Path) -> list[TrialRow]:
    """The run's trials that a rater can see: with a verdict and a recording.

    Raises:
        ScenarioError: there are none.
    """
    rows = read_trial_log(run / TRIALS_FILE)
    found = [
        r for r in rows if r.robot is not None and r.robot["episode"] is not None
        and r.robot["verdict"] != "invalid"
    ]  # fmt: skip
    if not found:
        raise ScenarioError(
            f"{run} has no recorded trials with a verdict; is it a run of `roborecover robot run`?"
        )
    return found


def agreement_of(run: Path) -> dict[str, tuple[int, float, float]]:
    """By second rater: trials rated by both, share of equal verdicts, and Cohen's kappa (NaN where one rater
    gave one verdict alone)."""
    first = {r.robot["episode"]: r.robot["verdict"] for r in recorded(run) if r.robot is not None}
    found = {}
    for path in sorted((run / FOLDER).glob("*.jsonl")):
        second = {r["episode"]: r["verdict"] for r in read_journal(path, SCHEMA)}
        both = [(first[e] == "success", v == "success") for e, v in second.items() if e in first]
        if both:
            one, other = np.array(both, bool).T
            found[path.stem] = (len(both), float((one == other).mean()), cohens_kappa(one, other))
    return found


def cohens_kappa(one: np.ndarray, other: np.ndarray) -> float:
    """Cohen's kappa of two raters' yes-or-no verdicts, (N,) bool each; NaN where chance agrees always."""
    agree = float((one == other).mean())
    chance = float(one.mean() * other.mean() + (1 - one.mean()) * (1 - other.mean()))
    return float("nan") if chance >= 1.0 else (agree - chance) / (1 - chance)
