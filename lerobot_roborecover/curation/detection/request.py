"""From detectors by name to their numbers: what `roborecover eval-monitor --detector` does."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

from lerobot_roborecover.analysis.conformal import least_rollouts
from lerobot_roborecover.analysis.contrasts import Contrast
from lerobot_roborecover.analysis.detection import ScoredTrial, detection_report
from lerobot_roborecover.analysis.detection_page import MeasuredDetector
from lerobot_roborecover.analysis.detection_pairs import detector_contrasts
from lerobot_roborecover.analysis.named_path import split_named
from lerobot_roborecover.curation.detection.fitting import (
    check_training_data,
    fit_features,
    fit_gain,
    fit_states,
)
from lerobot_roborecover.curation.detection.forked import ForkLog, read_forks, see_forks
from lerobot_roborecover.curation.detection.scoring import PolicyLooks, cost_ms, score_trials
from lerobot_roborecover.curation.detection.trials import SeenTrial, TrialSource, see_trials
from lerobot_roborecover.curation.monitor_data.data import check_disjoint
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.datasets.trajectories import ScenarioLink
from lerobot_roborecover.env.facts import facts_of
from lerobot_roborecover.interventions.detectors.base import DetectorRewardModel
from lerobot_roborecover.interventions.detectors.interface import Detector, MonitorDetector
from lerobot_roborecover.interventions.detectors.loading import (
    check_needs,
    load_detector,
    split_options,
)
from lerobot_roborecover.interventions.detectors.modeling_policy import (
    FeatureNetwork,
    RoboRecoverPolicyFeaturesRewardModel,
    RoboRecoverRecoveryGainRewardModel,
)
from lerobot_roborecover.interventions.detectors.modeling_states import (
    RoboRecoverStateDistanceRewardModel,
)
from lerobot_roborecover.interventions.detectors.probe import PolicyProbe
from lerobot_roborecover.interventions.detectors.progress import ProgressDetector
from lerobot_roborecover.interventions.monitor.errors import MonitorError
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.whole import new_folder

TRUTHS = ("recovery_point", "outcome")
"""Both are known once trials are over."""
DETECTORS_FOLDER = "detectors"
"""In the folder of the report: those that a composite policy can load."""


@dataclass(frozen=True)
class DetectionRequest:
    """What is compared, and on what."""

    detectors: Sequence[str]
    """`[NAME=]WHAT[,option=value...]` each (`interventions.detectors.loading.load_detector`)."""
    source: TrialSource
    split: str = "test"
    fit_split: str = "train"
    """Scenarios whose trials detectors that learn are fitted to."""
    fit_select: str | None = None
    """Which of them; None takes those that `source.select` takes."""
    training_data: Path | None = None
    """LeRobotDataset that the policy was trained on, for the distance from training states."""
    forks: Path | None = None
    """Log of `roborecover fork` on the policy's trials, for the expected gain."""
    alpha: float = 0.1
    """False-alarm rate of the conformal thresholds, a clean rollout."""
    on_training_scenarios: bool = False
    device: str | None = None
    base_model: str | None = None
    """Of a Qwen3-VL monitor whose base has moved."""
    level: float = 0.95
    seed: int = 0
    """Of the halves of the scenarios."""
    against: Sequence[str] = ()
    """Names of detectors; pairs without one of them are not tested. Empty: all pairs are."""


@dataclass(frozen=True)
class Detection:
    """What came out."""

    measured: list[MeasuredDetector]
    trials: list[SeenTrial]
    scored: dict[str, list[ScoredTrial]]
    """By detector."""
    dropped: Counter
    remarks: list[str]
    pairs: list[Contrast]
    """Of detectors, but for the oracle, which reads outcomes."""


@dataclass
class NamedDetector:
    """A detector under the name that the user gave it."""

    name: str
    what: str
    detector: Detector
    fitted_to: str = ""

    @property
    def decides(self) -> bool:
        """Whether it has decisions of its own."""
        if isinstance(self.detector, DetectorRewardModel):
            return self.detector.config.threshold is not None
        return not isinstance(self.detector, ProgressDetector) or self.detector.options.threshold is not None

    @property
    def probabilities(self) -> bool:
        """Whether its scores are probabilities."""
        return isinstance(self.detector, MonitorDetector | RoboRecoverPolicyFeaturesRewardModel)

    @property
    def trained_on(self) -> Mapping[str, Any]:
        """What it was trained on, as far as it says."""
        inner = self.detector.monitor if isinstance(self.detector, MonitorDetector) else self.detector
        return getattr(inner, "trained_on", {}).get("scenarios", {})


def compare_detectors(
    request: DetectionRequest, out: Path, progress: Callable[[str, int, int], None]
) -> Detection:
    """Loads, checks, runs, fits, scores and measures; what a composite policy can use is saved.

    Args:
        request: what to compare.
        out: folder of the report.
        progress: told of what, how many are done, of how many.

    Raises:
        OptionError, ScenarioError, SimulatorError, TrialLogError: what cannot be done, and the remedy; what
            detectors lack is said before anything runs.
    """
    if not 0.0 < request.alpha < 1.0:
        raise MonitorError(f"--alpha={request.alpha}: must be above 0 and below 1")
    source = request.source
    scenarios = load_scenarios(
        source.scenarios, revision=source.revision, split=request.split, select=source.select
    )
    named = [_load(text, request) for text in request.detectors]
    if len({n.name for n in named}) < len(named):
        raise MonitorError(
            f"two detectors have one name: {[n.name for n in named]}; write --detector NAME=WHAT"
        )
    tested = [n.name for n in named if not _knows(n.what)]
    unknown = sorted(set(request.against) - set(tested))
    if unknown:
        raise MonitorError(f"--against {unknown[0]!r:.80}: those that are tested are {', '.join(tested)}")
    links = [ScenarioLink(s.id, s.sha256(), "") for s in scenarios]
    if not request.on_training_scenarios:
        for n in named:
            _check_held_out(n, links)
    _check_fitting(named, request)
    forks = _forks(named, request, links)
    host, features = _host(request, scenarios.platform)
    policy, pre, _ = host.parts
    probe = PolicyProbe(policy, pre)
    for n in named:
        check_needs(f"--detector {n.name}", n.detector.needs, features, probe, TRUTHS)
    looks = PolicyLooks(probe)
    trials, dropped = see_trials(source, request.split, host.env_batch, progress)
    _fit(named, request, forks, host, looks, links, progress)
    remarks = _remarks(trials, request)
    measured, scored = [], {}
    for n in named:
        told = f"scores of {n.name}"
        scored[n.name] = score_trials(
            n.detector, trials, looks, lambda done, total, told=told: progress(told, done, total)
        )
        report = detection_report(
            scored[n.name], alpha=request.alpha, probabilities=n.probabilities, decides=n.decides,
            seed=request.seed, level=request.level,
        )  # fmt: skip
        saved = _save(n, report.threshold, out)
        cost = cost_ms(n.detector, trials, probe)
        measured.append(
            MeasuredDetector(
                n.name, n.what, _reads(n.detector), n.fitted_to, n.probabilities, report, cost, saved
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
    if request.base_model and isinstance(detector, MonitorDetector):
        detector = load_detector(what, request.device, base_model=request.base_model)
    kind = split_options(what)[0]
    return NamedDetector(name or Path(kind).name, what, detector)


def _host(request: DetectionRequest, platform: str) -> tuple[Any, dict[str, Any]]:
    """The policy's host, and what its environment gives."""
    from lerobot.envs.utils import env_to_policy_features

    from lerobot_roborecover.policies.policy_host import PolicyHost
    from lerobot_roborecover.trials import load

    source = request.source
    env = source.env_config(platform, request.split, "recovery")
    config = load.policy_config(source.policy, (), source.device)
    host = load.load_host(load.HostSpec(config, env, {}, source.run_seed))
    if not isinstance(host, PolicyHost):
        raise MonitorError(
            f"--policy {source.policy}: detectors are compared on a LeRobot checkpoint that runs in this "
            f"process; this is a {config.type!r} policy. Name the policy within"
        )
    return host, env_to_policy_features(env)


def _check_held_out(named: NamedDetector, links: Sequence[ScenarioLink]) -> None:
    trained = [ScenarioLink(i, sha, "") for i, sha in named.trained_on.items()]
    check_disjoint(trained, links, f"--detector {named.name}")


def _learns_from_trials(named: NamedDetector, request: DetectionRequest) -> bool:
    learns = not getattr(named.detector, "fitted", True) and not _learns_from_forks(named.detector)
    of_states = isinstance(named.detector, RoboRecoverStateDistanceRewardModel)
    return learns and not (of_states and request.training_data is not None)


def _learns_from_forks(detector: Detector) -> TypeGuard[RoboRecoverRecoveryGainRewardModel]:
    return isinstance(detector, RoboRecoverRecoveryGainRewardModel) and not detector.fitted


def _forks(
    named: Sequence[NamedDetector], request: DetectionRequest, links: Sequence[ScenarioLink]
) -> dict[str, ForkLog]:
    """By detector, the forks that it learns from; refused before anything runs."""
    from lerobot_roborecover.trials.load import policy_config

    learning = {n.name: d for n in named if _learns_from_forks(d := n.detector)}
    if bool(learning) != (request.forks is not None):
        raise MonitorError(
            f"--detector {min(learning)} learns from forks: give --forks LOG, which `roborecover fork` makes "
            "of the policy's trials on other scenarios"
            if learning
            else f"--forks {request.forks}: no detector learns from forks; add --detector recovery_gain"
        )
    if request.forks is None:
        return {}
    source = request.source
    policy = facts_of(policy_config(source.policy, (), source.device)).policy
    found = {name: read_forks(request.forks, policy, d.config.arm) for name, d in learning.items()}
    for log in found.values():
        check_disjoint(log.links, links, f"--forks {request.forks}")
    return found


def _shared(request: DetectionRequest) -> bool:
    """Whether scenarios that are fitted to are measured on, too."""
    source = request.source
    fitted, measured = (
        {s.id for s in load_scenarios(source.scenarios, revision=source.revision, split=split, select=select)}
        for split, select in (
            (request.fit_split, source.select if request.fit_select is None else request.fit_select),
            (request.split, source.select),
        )
    )
    return bool(fitted & measured)


def _check_fitting(named: Sequence[NamedDetector], request: DetectionRequest) -> None:
    """Refuses to fit to what is measured on, or to a training set that is not there; before anything runs."""
    learning = [n.name for n in named if _learns_from_trials(n, request)]
    if learning and request.fit_split == request.split and _shared(request):
        raise ScenarioError(
            f"--fit-split {request.fit_split} is what is measured on; detectors that learn "
            f"({', '.join(learning)}) are fitted to other scenarios"
        )
    if request.training_data is not None:
        check_training_data(request.training_data)


def _fit(
    named: Sequence[NamedDetector],
    request: DetectionRequest,
    forks: Mapping[str, ForkLog],
    host: Any,
    looks: PolicyLooks,
    links: Sequence[ScenarioLink],
    progress: Callable[[str, int, int], None],
) -> None:
    todo = [n for n in named if not getattr(n.detector, "fitted", True)]
    trials: list[SeenTrial] = []
    if any(_learns_from_trials(n, request) for n in todo):
        source = request.source
        if request.fit_select is not None:
            source = replace(source, select=request.fit_select)
        trials, _ = see_trials(source, request.fit_split, host.env_batch, progress)
    for n in todo:
        if isinstance(n.detector, RoboRecoverStateDistanceRewardModel):
            n.fitted_to = fit_states(n.detector, trials, request.training_data)
        elif isinstance(n.detector, RoboRecoverPolicyFeaturesRewardModel):
            n.fitted_to = fit_features(n.detector, trials, looks)
        elif isinstance(n.detector, RoboRecoverRecoveryGainRewardModel):
            seen = see_forks(forks[n.name], request.source, host.env_batch, progress)
            n.fitted_to = fit_gain(n.detector, seen, looks)
            n.detector.config.arm = forks[n.name].arm
        if isinstance(n.detector, FeatureNetwork):
            n.detector.config.policy = looks.probe.kind if looks.probe else ""
        _check_held_out(n, links)


def _remarks(trials: Sequence[SeenTrial], request: DetectionRequest) -> list[str]:
    clean = sum(t.row.start == "initial" and t.row.success for t in trials)
    least = least_rollouts(request.alpha)
    if clean // 2 >= least:
        return []
    return [
        f"{clean} successful clean rollouts, about half of them for each threshold: at a false-alarm rate of "
        f"{request.alpha:g} at least {least} are needed for a finite one. Detectors without one never alarm; "
        "give more scenarios, or a higher --alpha"
    ]


def _save(named: NamedDetector, threshold: float, out: Path) -> str:
    """Where a composite policy finds it with its threshold; empty where it is no detector of ours, cannot be
    used, or has no threshold."""
    detector = named.detector
    if not isinstance(detector, DetectorRewardModel) or detector.needs.truth or not math.isfinite(threshold):
        return ""
    folder = out / DETECTORS_FOLDER / named.name
    own = detector.config
    detector.config = replace(own, threshold=max(threshold, detector.least_threshold))
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with new_folder(folder, replace=True) as temporary:
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
