"""Which detectors learn, and from what; never from what is measured on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeGuard

from lerobot_roborecover.datasets import ScenarioSet, load_scenarios
from lerobot_roborecover.datasets.trajectories import ScenarioLink
from lerobot_roborecover.detection.data.data import check_disjoint
from lerobot_roborecover.detection.fitting import (
    check_training_data,
    fit_features,
    fit_gain,
    fit_states,
)
from lerobot_roborecover.detection.forked import ForkLog, read_forks, see_forks
from lerobot_roborecover.detection.scoring import PolicySignals
from lerobot_roborecover.detection.trials import ReplayedTrial, TrialSource, replay_trials
from lerobot_roborecover.policies.detectors.interface import Detector, DetectorError
from lerobot_roborecover.policies.detectors.modeling_policy import (
    FeatureNetwork,
    RoboRecoverPolicyFeaturesRewardModel,
    RoboRecoverRecoveryGainRewardModel,
)
from lerobot_roborecover.policies.detectors.modeling_states import (
    RoboRecoverStateDistanceRewardModel,
)
from lerobot_roborecover.policies.metadata import policy_metadata
from lerobot_roborecover.scenario import ScenarioError

if TYPE_CHECKING:
    from lerobot_roborecover.detection.options import DetectionRequest
    from lerobot_roborecover.detection.request import NamedDetector


def check_held_out(named: NamedDetector, links: Sequence[ScenarioLink]) -> None:
    """Refuses a detector that was trained on scenarios that are measured on.

    Raises:
        ScenarioError: naming one.
    """
    trained = [ScenarioLink(i, sha, "") for i, sha in named.trained_on.items()]
    check_disjoint(trained, links, f"--detector {named.name}")


def _fit_source(request: DetectionRequest) -> TrialSource:
    """That of the trials that are fitted to."""
    if request.fit_select is None:
        return request.source
    return replace(request.source, select=request.fit_select)


def _fitted_to(request: DetectionRequest) -> ScenarioSet:
    source = _fit_source(request)
    return load_scenarios(
        source.scenarios, revision=source.revision, split=request.fit_split, select=source.select
    )


def _learns_from_trials(named: NamedDetector, request: DetectionRequest) -> bool:
    learns = not getattr(named.detector, "fitted", True) and not _learns_from_forks(named.detector)
    of_states = isinstance(named.detector, RoboRecoverStateDistanceRewardModel)
    return learns and not (of_states and request.training_data is not None)


def _learns_from_forks(detector: Detector) -> TypeGuard[RoboRecoverRecoveryGainRewardModel]:
    return isinstance(detector, RoboRecoverRecoveryGainRewardModel) and not detector.fitted


def fork_logs(
    named: Sequence[NamedDetector], request: DetectionRequest, links: Sequence[ScenarioLink]
) -> dict[str, ForkLog]:
    """By name of a detector, the forks that it learns from; refused before anything runs.

    Args:
        named: the detectors.
        request: names the log.
        links: what is measured on.

    Raises:
        DetectorError, ScenarioError: the log is missing, of another policy, or of the scenarios measured on;
            or no detector learns from it.
    """
    from lerobot_roborecover.evaluation.loading import policy_config

    learning = {n.name: d for n in named if _learns_from_forks(d := n.detector)}
    if bool(learning) != (request.forks is not None):
        raise DetectorError(
            f"--detector {min(learning)} learns from forks: give --forks LOG, which `roborecover detect "
            "fork` makes of the policy's trials on other scenarios"
            if learning
            else f"--forks {request.forks}: no detector learns from forks; add --detector recovery_gain"
        )
    if request.forks is None:
        return {}
    source = request.source
    policy = policy_metadata(policy_config(source.policy, (), source.device)).policy
    found = {name: read_forks(request.forks, policy, d.config.arm) for name, d in learning.items()}
    for log in found.values():
        check_disjoint(log.links, links, f"--forks {request.forks}")
    return found


def check_fitting(
    named: Sequence[NamedDetector], request: DetectionRequest, links: Sequence[ScenarioLink]
) -> None:
    """Refuses to fit to what is measured on, or to a training set that is not there; before anything runs.

    Args:
        named: the detectors.
        request: what they are fitted to.
        links: what is measured on.

    Raises:
        DetectorError, ScenarioError: saying which.
    """
    learning = [n.name for n in named if _learns_from_trials(n, request)]
    if learning and {s.id for s in _fitted_to(request)} & {link.id for link in links}:
        raise ScenarioError(
            f"--fit-split {request.fit_split} is what is measured on; detectors that learn "
            f"({', '.join(learning)}) are fitted to other scenarios"
        )
    if request.training_data is not None:
        check_training_data(request.training_data)


def fit_detectors(
    named: Sequence[NamedDetector],
    request: DetectionRequest,
    forks: Mapping[str, ForkLog],
    host: Any,
    looks: PolicySignals,
    links: Sequence[ScenarioLink],
    progress: Callable[[str, int, int], None],
) -> None:
    """Fits those that learn.

    Args:
        named: the detectors; those that are fitted already stay as they are.
        request: what they are fitted to.
        forks: of `fork_logs`.
        host: the policy's.
        looks: into that policy.
        links: what is measured on.
        progress: as of `replay_trials`.
    """
    todo = [n for n in named if not getattr(n.detector, "fitted", True)]
    trials: list[ReplayedTrial] = []
    if any(_learns_from_trials(n, request) for n in todo):
        trials, _ = replay_trials(_fit_source(request), request.fit_split, host.env_batch, progress)
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
        check_held_out(n, links)
