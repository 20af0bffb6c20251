"""Interface of recovery monitors, as the composite policy uses them.

Contract for implementations:

- `monitor_loading.load_monitor(path, device)` returns an object of the protocol below from a folder or Hub
  id. It uses LeRobot's own reward-model loaders and the processors saved beside the model.
- A monitor is stateless: its score of an observation depends on that observation (and instruction) alone, so
  that trials may share a batch, be resumed, and be interleaved in any order.
- It is called at every environment step after the handoff, the handoff's own observation included, until its
  first trigger in the trial; never on replayed actions (paper, "Monitor Training and Triggering").
- An answer that cannot be read is a NaN score and never a trigger; the trial row counts it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Verdicts:
    """What a monitor said of B observations."""

    scores: np.ndarray
    """(B,) float32: how far the execution has gone wrong, from monitors in [0, 1], from other detectors on
    their own scale; NaN where the answer is unparsable."""
    triggers: np.ndarray
    """(B,) bool: intervene now. Never True where the score is NaN."""


@runtime_checkable
class Monitor(Protocol):
    """Says of each observation whether execution has gone wrong."""

    input_features: Mapping[str, Any]
    """What it reads, by LeRobot key (`observation.images.image`, `observation.state`, ...), as
    `PolicyFeature`s. A key the environment does not give is refused before the first trial."""
    max_batch: int
    """Observations it can judge at once."""

    def judge(self, observations: Mapping[str, torch.Tensor], instructions: Sequence[str]) -> Verdicts:
        """Judges a batch.

        Args:
            observations: as they leave the env preprocessor, before any policy's own preprocessor: LeRobot
                keys, batch axis first; pictures (B, 3, H, W) float32 in [0, 1], vectors (B, n) float32. May
                hold more keys than it reads.
            instructions: B language instructions.
        """


@runtime_checkable
class TrainedMonitor(Monitor, Protocol):
    """A monitor that knows what it was trained on, as all of ours do."""

    config: Any
    """Of LeRobot's reward model."""
    trained_on: Mapping[str, Any]
    """Scenarios and labels of the training set; empty where they are not known."""
