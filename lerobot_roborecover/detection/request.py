"""From detectors by name to their numbers: what `roborecover detect evaluate` does."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_roborecover.analysis.named_path import split_named
from lerobot_roborecover.analysis.pages.detection import MeasuredDetector
from lerobot_roborecover.analysis.stats.conformal import least_rollouts
from lerobot_roborecover.analysis.stats.contrasts import Contrast
from lerobot_roborecover.analysis.stats.detection import ScoredTrial, detection_report
from lerobot_roborecover.analysis.stats.detection_pairs import detector_contrasts
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.datasets.trajectories import ScenarioLink
from lerobot_roborecover.detection.learning import (
    check_fitting,
    check_held_out,
    fit_detectors,
    fork_logs,
)
from lerobot_roborecover.detection.options import DetectionRequest
from lerobot_roborecover.detection.scoring import PolicySignals, cost_ms, score_trials
from lerobot_roborecover.detection.trials import ReplayedTrial, replay_trials
from lerobot_roborecover.policies.detectors.base import DetectorRewardModel
from lerobot_roborecover.policies.detectors.interface import Detector, DetectorError
from lerobot_roborecover.policies.detectors.loading import (
    check_needs,
    load_detector,
    split_options,
)
from lerobot_roborecover.policies.detectors.monitor.base import MonitorRewardModel
from lerobot_roborecover.policies.detectors.probe import PolicyProbe
from lerobot_roborecover.utils.atomic_io import atomic_dir

TRUTHS = ("recovery_point", "outcome")
"""Both are known once trials are over."""
DETECTORS_FOLDER = "detectors"
"""In the folder of the report: those that a composite policy can load."""


@dataclass(frozen=True)
class Detection:
    """Results of a detector comparison."""

    measured: list[MeasuredDetector]
    trials: list[ReplayedTrial]
    scored: dict[str, list[ScoredTrial]]
    """By detector."""
    dropped: Counter
    remarks: list[str]
    pairs: list[Contrast]
    """Pairs of detectors, but for the oracle, which reads outcomes."""


@dataclass
class NamedDetector:
    """A detector under the name that the user gave it."""

    name: str
    what: str
    detector: Detector
    fitted_to: str = ""

    @property
    def trained_on(self) -> Mapping[str, Any]:
        """Hashes by id of the scenarios that it was trained on, as far as it says."""
        return self.detector.trained_on.get("scenarios", {})


def compare_detectors(
    request: DetectionRequest, out: Path, progress: Callable[[str, int, int], None]
) -> Detection:
    """Loads, checks, runs, fits, scores and measures; what a composite policy can use is saved.

    Args:
        request: what to compare.
        out: folder of the report.
        progress: called with the step's name, how many are done, and of how many.

    Raises:
        OptionError, ScenarioError, SimulatorError, TrialLogError: what cannot be done, and the remedy; what
            detectors lack is said before anything runs.
    """
    if not 0.0 < request.alpha < 1.0:
        raise DetectorError(f"--alpha={request.alpha}: must be above 0 and below 1")
    source = request.source
    scenarios = load_scenarios(
        source.scenarios, revision=source.revision, split=request.split, select=source.select
    )
    named = [_load(text, request) for text in request.detectors]
    if len({n.name for n in named}) < len(named):
        raise DetectorError(
            f"two detectors have one name: {[n.name for n in named]}; write --detector NAME=WHAT"
        )
    tested = [n.name for n in named if not _knows(n.what)]
    unknown = sorted(set(request.against) - set(tested))
    if unknown:
        raise DetectorError(f"--against {unknown[0]!r:.80}: those that are tested are {', '.join(tested)}")
    links = [ScenarioLink(s.id, s.sha256(), "") for s in scenarios]
    if not request.on_training_scenarios:
        for n in named:
            check_held_out(n, links)
    check_fitting(named, request, links)
    forks = fork_logs(named, request, links)
    host, features = _host(request, scenarios.platform)
    policy, pre, _ = host.parts
    probe = PolicyProbe(policy, pre)
    for n in named:
        check_needs(f"--detector {n.name}", n.detector.needs, features, probe, TRUTHS)
    looks = PolicySignals(probe)
    trials, dropped = replay_trials(source, request.split, host.env_batch, progress)
    fit_detectors(named, request, forks, host, looks, links, progress)
    remarks = _remarks(trials, request)
    measured, scored = [], {}
    for n in named:
        told = f"scores of {n.name}"
        scored[n.name] = score_trials(
            n.detector, trials, looks, lambda done, total, told=told: progress(told, done, total)
        )
        report = detection_report(
            scored[n.name], alpha=request.alpha, probabilities=n.detector.probabilities,
            decides=n.detector.decides, seed=request.seed, level=request.level,
        )  # fmt: skip
        saved = _save(n, report.threshold, out)
        cost = cost_ms(n.detector, trials, probe)
        measured.append(
            MeasuredDetector(
                n.name, n.what, _reads(n.detector), n.fitted_to, n.detector.probabilities, report, cost, saved
            )
        )
    reports = {m.name: m.report for m in measured if m.name in tested}
    pairs = detector_contrasts(reports, against=request.against, level=request.level)
    return Detection(measured, trials, scored, dropped, remarks, pairs)


def _knows(what: str) -> bool:
    """Whether a detector reads outcomes, so that no test can mean anything."""
    return split_options(what)[0] == "oracle"


def _load(text: str, request: DetectionRequest) -> NamedDetector:
    head, _ = split_options(text)
    name, _ = split_named(head)
    what = text[len(name) + 1 :] if name else text
    detector = load_detector(what, request.device)
    if request.base_model and isinstance(detector, MonitorRewardModel):
        detector = load_detector(what, request.device, base_model=request.base_model)
    kind = split_options(what)[0]
    return NamedDetector(name or Path(kind).name, what, detector)


def _host(request: DetectionRequest, platform: str) -> tuple[Any, dict[str, Any]]:
    """The policy's host, and what its environment gives."""
    from lerobot.envs.utils import env_to_policy_features

    from lerobot_roborecover.evaluation import loading
    from lerobot_roborecover.policies.local_runner import LocalPolicyRunner

    source = request.source
    env = source.env_config(platform, request.split, "recovery")
    config = loading.policy_config(source.policy, (), source.device)
    host = loading.load_host(loading.HostSpec(config, env, {}, source.run_seed))
    if not isinstance(host, LocalPolicyRunner):
        raise DetectorError(
            f"--policy {source.policy}: detectors are compared on a LeRobot checkpoint that runs in this "
            f"process; this is a {config.type!r} policy. Name the policy within"
        )
    return host, env_to_policy_features(env)


def _remarks(trials: Sequence[ReplayedTrial], request: DetectionRequest) -> list[str]:
    clean = len({t.unit for t in trials if t.row.start == "initial" and t.row.success})
    least = least_rollouts(request.alpha)
    if clean // 2 >= least:
        return []
    return [
        f"successful clean rollouts from {clean} first states, about half of them for each threshold: at a "
        f"false-alarm rate of {request.alpha:g} at least {least} are needed for a finite one. Detectors "
        "without one never alarm; give more scenarios, or a higher --alpha"
    ]


def _save(named: NamedDetector, threshold: float, out: Path) -> str:
    """Where a composite policy finds it with its threshold; empty where it is no detector of ours, cannot be
    used, or has no threshold."""
    detector = named.detector
    own = isinstance(detector, DetectorRewardModel) and not isinstance(detector, MonitorRewardModel)
    if not own or detector.needs.truth or not math.isfinite(threshold):
        return ""
    folder = out / DETECTORS_FOLDER / named.name
    own = detector.config
    detector.config = replace(own, threshold=max(threshold, detector.least_threshold))
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with atomic_dir(folder, replace=True) as temporary:
            detector.save_pretrained(temporary)
    finally:
        detector.config = own
    return str(folder)


def _reads(detector: Detector) -> str:
    needs = detector.needs
    parts = list(needs.features)
    parts += [f"{needs.chunks} action chunks"] if needs.chunks else []
    parts += ["the policy's features"] if needs.internals else []
    parts += [f"the {needs.truth.replace('_', ' ')}"] if needs.truth else []
    back = f", {needs.past} steps back" if needs.past else ""
    return (", ".join(parts) or "nothing") + back
