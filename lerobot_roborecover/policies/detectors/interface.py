"""Interface of failure detectors: a window of a trial's steps in, a score out.

Contract for implementations:

- A detector is stateless: its score of a window depends on that window alone. So trials may share a batch, be
  resumed, and be interleaved in any order. The caller keeps the history.
- It declares what it needs (`DetectorNeeds`): observation keys, the length of the window, action chunks of
  the acting policy, the policy's features, or a ground truth that is unknown while a trial runs.
- A higher score means that failure is more likely. A score of NaN means no answer, and never triggers.

A recovery monitor is a detector that looks at the last observation alone. It is called at every environment
step after the handoff, the handoff's own observation included, until its first trigger in the trial; never on
replayed actions (paper, "Monitor Training and Triggering"). An answer that cannot be read is a NaN score, and
the trial row counts it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from lerobot_roborecover.errors import OptionError

if TYPE_CHECKING:
    import torch

TASK = "task"
"""LeRobot's batch key of the language instructions."""
CHUNKS = "policy.chunks"
"""Batch key: (B, T, K, H, A) float32, K action chunks that the policy would begin at each step of the window,
as it predicts them (normalised)."""
FEATURES = "policy.features"
"""Batch key: (B, F) float32, the policy's own features at the last step."""
STEP = "roborecover.watched_step"
"""Batch key: (B,) int64, environment steps since the watch began."""
SEEN = "roborecover.seen"
"""Batch key: (B,) int64, steps of the window that have been; those before them repeat the first."""
SEED = "roborecover.seed"
"""Batch key: (B,) int64, the trial's."""
DEVIATED = "roborecover.deviated"
"""Batch key: (B,) float32, 1 from the recovery point on; NaN where unknown."""
WILL_FAIL = "roborecover.will_fail"
"""Batch key: (B,) float32, 1 where the policy does not recover by itself; NaN where unknown."""


@dataclass(frozen=True)
class DetectorNeeds:
    """Inputs that a detector needs."""

    features: Mapping[str, Any] = field(default_factory=dict)
    """Observations, by LeRobot key, as `PolicyFeature`s."""
    past: int = 0
    """Steps before now that it looks back at."""
    chunks: int = 0
    """Action chunks of the acting policy, sampled at every step of the window."""
    internals: bool = False
    """The acting policy's own features."""
    truth: str = ""
    """`recovery_point` or `outcome`: known only in an evaluation."""

    @property
    def of_policy(self) -> bool:
        """Whether the acting policy is asked for something beside its actions."""
        return bool(self.chunks) or self.internals


@dataclass(frozen=True)
class StepObservation:
    """Inputs from one step of a trial."""

    observation: Mapping[str, torch.Tensor]
    """As it leaves the env preprocessor, without a batch axis: pictures (3, H, W) float32 in [0, 1]."""
    chunks: torch.Tensor | None = None
    """(K, H, A) float32."""
    features: torch.Tensor | None = None
    """(F,) float32."""


@dataclass(frozen=True)
class DetectorWindow:
    """The steps that a detector scores at once."""

    observations: Sequence[StepObservation]
    """From the oldest to now; as many as the detector looks back at and one, fewer where the watch has just
    begun."""
    instruction: str
    step: int
    """Environment steps since the watch began."""
    seed: int = 0
    """The trial's."""
    deviated: float = math.nan
    """1 from the recovery point on, 0 before it; NaN where unknown."""
    will_fail: float = math.nan
    """1 where the policy does not recover by itself, 0 where it does; NaN where unknown."""


@dataclass(frozen=True)
class Verdicts:
    """What a detector says of B windows."""

    scores: np.ndarray
    """(B,) float32: how far the execution has gone wrong, from monitors in [0, 1], from other detectors on
    their own scale; NaN where the answer is unparsable."""
    triggers: np.ndarray
    """(B,) bool: intervene now. Never True where the score is NaN."""


class DetectorError(OptionError):
    """A detector cannot be built, loaded, fitted or asked; the message names the value and the remedy."""


class Detector(Protocol):
    """Scores windows: a higher score means that failure is more likely."""

    @property
    def trained_on(self) -> Mapping[str, Any]:
        """`scenarios`: hashes by id of those that it was trained on; empty where they are not known."""

    @property
    def fitted(self) -> bool:
        """Whether it can be asked: False for one that has to be fitted first, and has not been."""

    @property
    def probabilities(self) -> bool:
        """Whether its scores are probabilities."""

    @property
    def needs(self) -> DetectorNeeds:
        """Inputs that it needs."""

    @property
    def max_batch(self) -> int:
        """Windows that it can judge at once."""

    @property
    def decides(self) -> bool:
        """Whether it triggers by itself; False for one without a threshold."""

    def judge_windows(self, windows: Sequence[DetectorWindow]) -> Verdicts:
        """Returns scores, and alarms at the detector's own threshold; none without a threshold."""


class DetectorHistory:
    """The recent steps of one trial, for one detector.

    Args:
        past: steps before now that are kept.
        seed: the trial's.
    """

    def __init__(self, past: int, seed: int | None):
        self._observations: deque[StepObservation] = deque(maxlen=past + 1)
        self._step, self._seed, self._instruction = -1, seed or 0, ""

    def show(self, observation: StepObservation, instruction: str) -> DetectorWindow:
        """The window that ends with this step."""
        self._observations.append(observation)
        self._step += 1
        self._instruction = instruction
        return self._window()

    def amend(self, chunks: torch.Tensor | None, features: torch.Tensor | None) -> DetectorWindow:
        """The same window, its last step with what the policy would do and computes there."""
        self._observations[-1] = StepObservation(self._observations[-1].observation, chunks, features)
        return self._window()

    def _window(self) -> DetectorWindow:
        return DetectorWindow(tuple(self._observations), self._instruction, self._step, self._seed)


def batch_of(windows: Sequence[DetectorWindow], needs: DetectorNeeds) -> dict[str, Any]:
    """Windows as a batch of LeRobot's reward models.

    Returns:
        Observations by key, (B, ...) where the detector looks at now alone, else (B, past + 1, ...), oldest
        first, the first repeated where the watch has just begun (as LeRobot's datasets do); `task`; and the
        keys of this module, those that are needed.
    """
    import torch

    batch: dict[str, Any] = {
        TASK: [w.instruction for w in windows],
        STEP: torch.tensor([w.step for w in windows]),
        SEEN: torch.tensor([len(w.observations) for w in windows]),
        SEED: torch.tensor([w.seed for w in windows]),
        DEVIATED: torch.tensor([w.deviated for w in windows], dtype=torch.float32),
        WILL_FAIL: torch.tensor([w.will_fail for w in windows], dtype=torch.float32),
    }
    rows = [_padded(w.observations, needs.past) for w in windows]
    for key in needs.features:
        if needs.past:
            batch[key] = torch.stack([torch.stack([g.observation[key] for g in row]) for row in rows])
        else:
            batch[key] = torch.stack([row[-1].observation[key] for row in rows])
    if needs.chunks:
        batch[CHUNKS] = torch.stack([torch.stack([_given(g.chunks) for g in row]) for row in rows])
    if needs.internals:
        batch[FEATURES] = torch.stack([_given(row[-1].features) for row in rows])
    return batch


def _padded(observations: Sequence[StepObservation], past: int) -> list[StepObservation]:
    row = list(observations[-(past + 1) :])
    return [row[0]] * (past + 1 - len(row)) + row


def _given(part: torch.Tensor | None) -> torch.Tensor:
    if part is None:
        raise ValueError("the detector was not given what it needs of the policy")
    return part


def scores_of(verdicts: Verdicts) -> np.ndarray:
    """(B,) float64 scores of verdicts."""
    return np.asarray(verdicts.scores, dtype=np.float64)
