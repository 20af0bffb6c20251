"""LeRobot's own reward models as detectors: `sarm`, `robometer`, `topreward`.

Their reward says how far the task has come. A failure is likely where it falls: the score is the reward of
`lag` steps ago less that of now; with `lag=0` it is the reward itself, turned round. Each is given the frames
that it was made for, from the history: one every `stride` steps up to now, or, for `sarm`, its own deltas,
those after now replaced by now.

Robometer rebuilds its backbone from its own checkpoint, but its tokenizer and image processor come from
`base_model_id`; TOPReward's backbone is `vlm_name`; SARM's encoder is always the Hub's
`openai/clip-vit-base-patch32` (LeRobot 0.6.1, `rewards/*/processor_*.py`). What the Hub has must have been
downloaded before, where there is no network.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_roborecover.policies.command_line import plain_output
from lerobot_roborecover.policies.detectors.interface import (
    SEEN,
    TASK,
    DetectorError,
    DetectorNeeds,
    DetectorWindow,
    Verdicts,
    batch_of,
)
from lerobot_roborecover.utils.text import install_command

PROGRESS_TYPES = ("sarm", "robometer", "topreward")


@dataclass(frozen=True)
class ProgressOptions:
    """Options for turning a reward into a score."""

    lag: int = 15
    """Steps over which a fall counts; 0 takes the reward itself, turned round."""
    stride: int = 4
    """Steps between the frames that it is given; SARM has its own."""
    threshold: float | None = None
    """Score above which it alarms; None never alarms."""
    max_batch: int = 8
    """Windows judged at once."""

    def __post_init__(self):
        if self.lag < 0 or self.stride < 1 or self.max_batch < 1:
            raise DetectorError(
                f"lag={self.lag}, stride={self.stride}, max_batch={self.max_batch}: lag from 0, the others "
                "from 1"
            )


class ProgressDetector:
    """A reward model of LeRobot's, asked about the end of each window, and about `lag` steps before it.

    Args:
        model: loaded, in evaluation mode.
        preprocessor: its own.
        options: how its reward becomes a score.
    """

    def __init__(self, model: Any, preprocessor: Any, options: ProgressOptions):
        self.model, self._pre, self.options = model, preprocessor, options
        config = model.config
        self.config = config
        self._frames = _frame_offsets(config, options.stride)
        features = {config.image_key: config.input_features[config.image_key]}
        if config.type == "sarm":
            features[config.state_key] = None
        self._needs = DetectorNeeds(features=features, past=-min(self._frames) + options.lag)
        self.trained_on: Mapping[str, Any] = {}
        self.fitted, self.probabilities = True, False

    @property
    def needs(self) -> DetectorNeeds:
        """Its camera, and the state for SARM."""
        return self._needs

    @property
    def max_batch(self) -> int:
        """Windows that it can judge at once."""
        return self.options.max_batch

    @property
    def decides(self) -> bool:
        return self.options.threshold is not None

    @torch.no_grad()
    def judge_windows(self, windows: Sequence[DetectorWindow]) -> Verdicts:
        """Scores, and which of them are above the threshold."""
        batch = batch_of(windows, self._needs)
        scores = -self._rewards(batch, 0)
        lag = self.options.lag
        if lag:
            scores = scores + self._rewards(batch, lag)
            scores[batch[SEEN] <= lag] = 0.0
        values = scores.float().cpu().numpy()
        threshold = self.options.threshold
        with_help = values > threshold if threshold is not None else np.zeros(len(values), bool)
        return Verdicts(scores=values, triggers=with_help & ~np.isnan(values))

    def _rewards(self, batch: Mapping[str, Any], before: int) -> Tensor:
        """(B,) rewards of `before` steps ago."""
        at = [self._needs.past - before + o for o in self._frames]
        given = {k: batch[k][:, at] for k in self._needs.features}
        if self.config.type != "sarm":
            prepared = self._pre({**given, TASK: batch[TASK]})
            return self.model.compute_reward(prepared).float().cpu()
        # LeRobot's encoding step takes one sample and one instruction at a time.
        found = []
        for i, text in enumerate(batch[TASK]):
            own = {k: v[i] for k, v in given.items()}
            prepared = self._pre({**own, TASK: text, "index": 0, "episode_index": 0})
            found.append(
                self.model.calculate_rewards(
                    prepared["text_features"], prepared["video_features"], prepared["state_features"],
                    lengths=prepared["lengths"], frame_index=self.config.n_obs_steps // 2,
                )
            )  # fmt: skip
        return torch.from_numpy(np.concatenate(found)).float()


def _frame_offsets(config: Any, stride: int) -> list[int]:
    """Steps of the frames, from now: 0 and below."""
    if config.type == "sarm":
        return [min(o, 0) for o in config.observation_delta_indices]
    count = config.max_frames or 16
    return [-stride * i for i in range(count - 1, -1, -1)]


def load_progress(path: str, config: Any, revision: str | None, options: ProgressOptions) -> ProgressDetector:
    """Loads one of LeRobot's reward models with its processors.

    Args:
        path: folder or Hub id.
        config: its configuration.
        revision: of a Hub id.
        options: how its reward becomes a score.

    Raises:
        DetectorError: a part of it is neither here nor to be had, or a package is missing.
    """
    from lerobot.rewards import get_reward_model_class
    from lerobot.rewards.factory import make_reward_pre_post_processors

    try:
        with plain_output():
            model = get_reward_model_class(config.type).from_pretrained(
                path, config=config, revision=revision
            )
        pre, _ = make_reward_pre_post_processors(config)
    except ImportError as err:
        raise DetectorError(
            f"{path}: a {config.type} reward model needs a package: {err}. {install_command('rewards')}"
        ) from err
    except (OSError, ValueError) as err:
        raise DetectorError(
            f"{path}: the {config.type} reward model cannot be loaded ({str(err)[:300]}). It needs "
            f"{_parts(config)}; without a network these must be in the Hub's cache already (`hf download`)"
        ) from err
    for step in pre.steps:
        to_eval = getattr(step, "eval", None)
        if callable(to_eval):  # SARM's would play frames backwards and change the instruction
            to_eval()
    model.eval()
    return ProgressDetector(model, pre, options)


def _parts(config: Any) -> str:
    if config.type == "sarm":
        return "its own weights and openai/clip-vit-base-patch32"
    if config.type == "robometer":
        return f"its own weights and the tokenizer and image processor of {config.base_model_id}"
    return f"the model {config.vlm_name} with its processor"
