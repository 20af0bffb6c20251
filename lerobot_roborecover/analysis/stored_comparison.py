"""A comparison of detectors, computed again from its stored scores: no simulator, policy or detector runs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_roborecover.analysis.detection_scores import read_scores
from lerobot_roborecover.analysis.pages.detection import (
    NUMBERS_FILE,
    SCHEMA_VERSION,
    SCORES_FOLDER,
    MeasuredDetector,
)
from lerobot_roborecover.analysis.stats.contrasts import Contrast
from lerobot_roborecover.analysis.stats.detection import ScoredTrial, detection_report
from lerobot_roborecover.analysis.stats.detection_pairs import detector_contrasts
from lerobot_roborecover.analysis.stats.estimators import RowsError


@dataclass(frozen=True)
class StoredComparison:
    """A comparison of detectors, computed again from their scores."""

    measured: list[MeasuredDetector]
    scored: dict[str, list[ScoredTrial]]
    pairs: list[Contrast]
    alpha: float
    level: float
    seed: int
    against: list[str]
    """Detectors that pairs were limited to; empty: all pairs were tested."""
    about: dict[str, Any]
    """What was measured, as the first report said it."""


def read_comparison(folder: Path) -> StoredComparison:
    """Computes a comparison of detectors again.

    Args:
        folder: the `--out` of `roborecover detect evaluate`; its numbers and scores are read.

    Raises:
        RowsError: the folder holds no such comparison, or a file is damaged.
    """
    path = folder / NUMBERS_FILE
    try:
        numbers = json.loads(path.read_bytes())
        version = numbers["schema_version"]
        if version != SCHEMA_VERSION:
            raise RowsError(f"{path}: schema_version {version!r:.80}; this version reads {SCHEMA_VERSION}")
        alpha, level, seed = float(numbers["alpha"]), float(numbers["level"]), int(numbers["seed"])
        detectors = dict(numbers["detectors"])
        stored_pairs = [(str(pair["a"]), str(pair["b"])) for pair in numbers["pairs"]]
        against = [str(name) for name in numbers["against"]]
        about = dict(numbers["about"])
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as err:
        if isinstance(err, RowsError):
            raise
        reason = f"it has no field {err}" if isinstance(err, KeyError) else str(err)[:200]
        raise RowsError(
            f"{path} is not the record of a comparison of detectors ({reason}). Name the --out of "
            "roborecover detect evaluate"
        ) from None
    scored = {name: read_scores(folder / SCORES_FOLDER / f"{Path(name).name}.npz") for name in detectors}
    measured = [_measured(name, scored[name], detectors[name], alpha, level, seed) for name in detectors]
    tested = {name for pair in stored_pairs for name in pair}
    reports = {m.name: m.report for m in measured if m.name in tested}
    pairs = detector_contrasts(reports, against=against, level=level)
    return StoredComparison(measured, scored, pairs, alpha, level, seed, against, about)


def _measured(
    name: str, trials: Sequence[ScoredTrial], said: Mapping[str, Any], alpha: float, level: float, seed: int
) -> MeasuredDetector:
    probabilities, decides = bool(said.get("probabilities")), said.get("own_decisions") is not None
    report = detection_report(
        trials, alpha=alpha, probabilities=probabilities, decides=decides, seed=seed, level=level
    )
    what, reads, fitted_to = (str(said.get(key, "")) for key in ("what", "reads", "fitted_to"))
    cost_ms = float(said.get("cost_ms") or 0.0)
    return MeasuredDetector(name, what, reads, fitted_to, probabilities, report, cost_ms)
