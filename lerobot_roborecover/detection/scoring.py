"""Asks detectors about every step of trials that are over, as a composite policy would have asked while they
ran."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lerobot_roborecover.analysis.stats.detection import ScoredTrial
from lerobot_roborecover.detection.trials import ReplayedTrial
from lerobot_roborecover.policies.detectors.interface import (
    Detector,
    DetectorNeeds,
    DetectorWindow,
    StepObservation,
    scores_of,
)
from lerobot_roborecover.policies.detectors.online import noise_seed
from lerobot_roborecover.policies.detectors.probe import PolicyProbe

_TIMED = 30
"""Single calls that are timed."""
_LOOKS_AT_ONCE = 64

type Looks = list[tuple[Tensor | None, Tensor | None]]
"""Chunks and features by step."""


@dataclass
class PolicySignals:
    """What the policy shows at every step of trials; asked once for all detectors that want the same.

    Args:
        probe: into the policy; None where no detector needs it.
    """

    probe: PolicyProbe | None

    def __post_init__(self):
        self._kept: dict[tuple[tuple, int, bool], list[Looks]] = {}

    def of(self, trial: ReplayedTrial, needs: DetectorNeeds) -> list[Looks]:
        """By segment of the trial, and step of it."""
        if not needs.of_policy or self.probe is None:
            return [[(None, None)] * (s.stop - s.start) for s in trial.segments]
        key = (trial.row.key(), needs.chunks, needs.internals)
        if key not in self._kept:
            self._kept[key] = [self._look(trial, s, needs, self.probe) for s in trial.segments]
        return self._kept[key]

    def _look(self, trial: ReplayedTrial, segment: slice, needs: DetectorNeeds, probe: PolicyProbe) -> Looks:
        steps = observations_of(trial, segment)
        found: Looks = []
        for at in range(0, len(steps), _LOOKS_AT_ONCE):
            numbers = range(at, min(at + _LOOKS_AT_ONCE, len(steps)))
            found += probe.look(
                [steps[max(n - probe.past, 0) : n + 1] for n in numbers],
                [trial.scenario.task.instruction] * len(numbers),
                [noise_seed(trial.row.trial_seed or 0, n) for n in numbers],
                needs,
            )
        return found


def observations_of(trial: ReplayedTrial, segment: slice) -> list[dict[str, Tensor]]:
    """Observations of a segment's steps, as they leave the env preprocessor."""
    arrays = {
        key: torch.from_numpy(value[segment]).float().div_(255)
        if value.dtype == np.uint8
        else torch.from_numpy(value[segment])
        for key, value in trial.observations.items()
    }
    return [{k: v[n] for k, v in arrays.items()} for n in range(segment.stop - segment.start)]


def windows_of(
    trial: ReplayedTrial, needs: DetectorNeeds, looks: PolicySignals
) -> list[list[DetectorWindow]]:
    """By segment of the trial, what a detector is asked about at each of its steps."""
    found = []
    for segment, looked in zip(trial.segments, looks.of(trial, needs), strict=True):
        observations = [
            StepObservation(o, *look) for o, look in zip(observations_of(trial, segment), looked, strict=True)
        ]
        replayed = segment.start < trial.handoff
        deviated, will_fail = float("nan"), float("nan")
        if trial.row.start == "recovery":
            deviated = float(not replayed)
        elif trial.row.success:
            deviated = 0.0
        if not replayed and (trial.row.start == "recovery" or trial.row.success):
            will_fail = float(not trial.row.success)
        found.append(
            [
                DetectorWindow(
                    observations[max(n - needs.past, 0) : n + 1], trial.scenario.task.instruction, n,
                    trial.row.trial_seed or 0, deviated, will_fail,
                )
                for n in range(len(observations))
            ]
        )  # fmt: skip
    return found


def score_trials(
    detector: Detector,
    trials: Sequence[ReplayedTrial],
    looks: PolicySignals,
    on_trial: Callable[[int, int], None] = lambda done, total: None,
) -> list[ScoredTrial]:
    """Scores of every step.

    Args:
        detector: loaded, and fitted where that is needed.
        trials: of the policy that it watches.
        looks: into that policy.
        on_trial: called with how many trials are done, of how many.
    """
    scored = []
    for number, trial in enumerate(trials, 1):
        scores, decisions = [], []
        for windows in windows_of(trial, detector.needs, looks):
            for at in range(0, len(windows), max(detector.max_batch, 1)):
                verdicts = detector.judge_windows(windows[at : at + max(detector.max_batch, 1)])
                scores.append(scores_of(verdicts))
                decisions.append(np.asarray(verdicts.triggers, dtype=bool))
        scored.append(
            ScoredTrial(
                trial.scenario.id, trial.unit, trial.row.start, trial.row.trial, trial.row.success,
                trial.control_hz, trial.handoff, np.concatenate(scores), np.concatenate(decisions),
            )
        )  # fmt: skip
        on_trial(number, len(trials))
    return scored


def cost_ms(detector: Detector, trials: Sequence[ReplayedTrial], probe: PolicyProbe | None) -> float:
    """Median milliseconds of one call about one step, with what the policy is asked for it; steps are spread
    over the trials."""
    needs = detector.needs
    spent = []
    for number in range(_TIMED):
        trial = trials[number * len(trials) // _TIMED]
        segment = trial.segments[-1]
        n = (number * 7919) % (segment.stop - segment.start)
        steps = observations_of(trial, slice(segment.start, segment.start + n + 1))
        text, seed = trial.scenario.task.instruction, trial.row.trial_seed or 0
        observations = [StepObservation(o) for o in steps[-(needs.past + 1) :]]
        if needs.of_policy and probe is not None:
            # Those of earlier steps are kept from step to step: only now's is asked for.
            ask = [(steps[max(k - probe.past, 0) : k + 1], k) for k in range(len(steps))][-needs.past - 1 :]
            earlier = [probe.look([w], [text], [noise_seed(seed, k)], needs)[0] for w, k in ask[:-1]]
            began = time.perf_counter()
            now = probe.look([ask[-1][0]], [text], [noise_seed(seed, n)], needs)[0]
            asked = time.perf_counter() - began
            observations = [
                StepObservation(g.observation, *look)
                for g, look in zip(observations, [*earlier, now], strict=True)
            ]
        else:
            asked = 0.0
        window = DetectorWindow(observations, text, n, seed, 0.0, 0.0)
        began = time.perf_counter()
        detector.judge_windows([window])
        spent.append(asked + time.perf_counter() - began)
    return 1000 * float(np.median(spent))
