"""Scores of detectors on disk, one file a detector."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.stats.detection import ScoredTrial
from lerobot_roborecover.analysis.stats.estimators import RowsError

MAX_SCORES = 50_000_000
"""Scores of one detector, 400 MB as float64; a set of 359 scenarios has about 100,000."""
_TRIAL_FIELDS = ("scenario", "unit", "start", "trial", "success", "control_hz", "handoff")


def write_scores(path: Path, trials: Sequence[ScoredTrial]) -> None:
    """Writes one detector's scores and decisions at every step of every trial."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fields: dict[str, Any] = {name: np.array([getattr(t, name) for t in trials]) for name in _TRIAL_FIELDS}
    np.savez_compressed(
        path,
        **fields,
        length=np.array([len(t.scores) for t in trials]),
        score=np.concatenate([t.scores for t in trials]),
        decision=np.concatenate([t.decisions for t in trials]),
    )


def read_scores(path: Path) -> list[ScoredTrial]:
    """Reads one detector's scores.

    Raises:
        RowsError: the file is no scores file of this version, or its parts contradict each other.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            missing = {*_TRIAL_FIELDS, "length", "score", "decision"} - set(file.files)
            if missing:
                raise RowsError(
                    f"{path} has no {sorted(missing)[0]!r}: it is no scores file, or an earlier version "
                    "wrote it. Run the comparison again"
                )
            length = file["length"]
            if length.ndim != 1 or length.dtype.kind != "i" or (length < 0).any():
                raise RowsError(f"{path}: 'length' is not a list of counts. Run the comparison again")
            total = int(length.sum())
            if total > MAX_SCORES:
                raise RowsError(f"{path} says that it holds {total} scores; the limit is {MAX_SCORES}")
            found = {name: file[name] for name in (*_TRIAL_FIELDS, "score", "decision")}
    except (OSError, ValueError, zipfile.BadZipFile) as err:
        if isinstance(err, RowsError):
            raise
        raise RowsError(f"cannot read the scores {path}: {str(err)[:200]}") from None
    shapes = {name: (total if name in ("score", "decision") else len(length),) for name in found}
    for name, values in found.items():
        if values.shape != shapes[name]:
            raise RowsError(f"{path}: {name!r} has shape {values.shape}, not {shapes[name]}; it is damaged")
    ends = np.cumsum(length)
    scores, decisions = np.split(found["score"], ends[:-1]), np.split(found["decision"], ends[:-1])
    return [
        ScoredTrial(
            str(found["scenario"][k]), str(found["unit"][k]), str(found["start"][k]), int(found["trial"][k]),
            bool(found["success"][k]), float(found["control_hz"][k]), int(found["handoff"][k]),
            scores[k].astype(float), decisions[k].astype(bool),
        )
        for k in range(len(length))
    ]  # fmt: skip
