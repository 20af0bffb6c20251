"""Loads the members of a composite policy by LeRobot's own loaders, each with its own processors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from lerobot.processor import PolicyAction, PolicyProcessorPipeline
from lerobot.utils.constants import ACTION

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.policies.checkpoint import check_checkpoint
from lerobot_roborecover.policies.interventions.configuration_intervention import MemberConfig
from lerobot_roborecover.policies.interventions.options import POLICY_TYPE
from lerobot_roborecover.policies.load_problems import plain_loading
from lerobot_roborecover.policies.local_runner import LocalPolicyRunner


class MemberHost(LocalPolicyRunner):
    """A policy that gets observations which have been through the env preprocessor already.

    Args:
        policy: a loaded LeRobot policy, in eval mode.
        preprocessor: its own.
        postprocessor: its own.
        max_batch: slots asked for at once, at most.
    """

    def __init__(
        self,
        policy: PreTrainedPolicy,
        preprocessor: PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
        postprocessor: PolicyProcessorPipeline[PolicyAction, PolicyAction],
        max_batch: int = 64,
    ):
        super().__init__(policy, _same, _same, preprocessor, postprocessor, max_batch)

    @property
    def action_width(self) -> int:
        return int(self._config.output_features[ACTION].shape[0])

    def _prepare(self, observations: Sequence[Mapping[str, Any]], instructions: Sequence[str]) -> Any:
        return self._pre({**join(observations), "task": list(instructions)})


def _same[T](value: T) -> T:
    return value


def join(observations: Sequence[Mapping[str, torch.Tensor]]) -> dict[str, torch.Tensor]:
    """One batch of observations that have a batch axis of 1 each."""
    return {key: torch.cat([o[key] for o in observations]) for key in observations[0]}


def load_member(
    role: str,
    member: MemberConfig,
    device: str,
    features: Mapping[str, PolicyFeature],
    action: PolicyFeature | None,
) -> MemberHost:
    """A member, checked against the environment.

    Args:
        role: `base` or `correction`, for messages.
        member: its options.
        device: where it runs.
        features: what the environment gives, by LeRobot name; empty where that is not known.
        action: what the environment takes, where known.

    Raises:
        OptionError: there is no such checkpoint, or it is of another observation or action space.
    """
    option = f"--policy.{role}.path={member.path}"
    check_checkpoint(member.path, option, member.revision)
    try:
        config = PreTrainedConfig.from_pretrained(member.path, revision=member.revision)
    except (FileNotFoundError, ValueError, OSError) as err:
        raise OptionError(f"{option}: no LeRobot policy there ({err})") from err
    if config.type == POLICY_TYPE:
        raise OptionError(f"{option}: is a composite policy itself; name the policy within")
    if config.type == "xvla":
        # LeRobot gives it an env preprocessor of its own, which a shared one cannot stand in for.
        raise OptionError(
            f"{option}: X-VLA reads observations that no other policy does, and cannot be a member. Serve it "
            "through the remote policy, and use that"
        )
    config.pretrained_path, config.pretrained_revision = Path(member.path), member.revision
    config.device = device
    if member.n_action_steps is not None:
        limit = getattr(config, "chunk_size", getattr(config, "horizon", member.n_action_steps))
        if not 1 <= member.n_action_steps <= limit:
            raise OptionError(
                f"--policy.{role}.n_action_steps={member.n_action_steps}: {member.path} predicts chunks of "
                f"{limit}"
            )
        vars(config)["n_action_steps"] = member.n_action_steps  # of those that act in chunks, not of the base
    _check(role, member, config, features, action)
    with plain_loading(option):
        policy = make_policy(config, env_cfg=_own_features(config))
        policy.eval()
        pre, post = make_pre_post_processors(
            policy_cfg=config,
            pretrained_path=member.path,
            pretrained_revision=member.revision,
            preprocessor_overrides={
                "device_processor": {"device": str(policy.config.device)},
                "rename_observations_processor": {"rename_map": member.rename_map},
            },
        )
    return MemberHost(policy, pre, post)


def _own_features(config: PreTrainedConfig) -> Any:
    """The checkpoint's own features in the form of an env config, so that `make_policy` leaves them alone."""
    features = {**(config.input_features or {}), **(config.output_features or {})}
    channels_last = {
        key: replace(f, shape=(*f.shape[1:], f.shape[0])) if f.type is FeatureType.VISUAL else f
        for key, f in features.items()
    }
    return SimpleNamespace(features=channels_last, features_map={key: key for key in features})


def _check(
    role: str,
    member: MemberConfig,
    config: PreTrainedConfig,
    features: Mapping[str, PolicyFeature],
    action: PolicyFeature | None,
) -> None:
    own = (config.output_features or {}).get(ACTION)
    if own is None or (action is not None and tuple(own.shape) != tuple(action.shape)):
        there = "none" if own is None else str(tuple(own.shape))
        wanted = "" if action is None else f"; the environment takes {tuple(action.shape)}"
        raise OptionError(
            f"--policy.{role}.path={member.path}: its action space is {there}{wanted}. Members must be "
            "trained for the same robot and control mode"
        )
    renamed = {member.rename_map.get(key, key): f for key, f in features.items()}
    for key, feature in (config.input_features or {}).items():
        if not features or feature.type is FeatureType.VISUAL:
            continue
        if key not in renamed or tuple(renamed[key].shape) != tuple(feature.shape):
            there = tuple(renamed[key].shape) if key in renamed else "nothing of that name"
            raise OptionError(
                f"--policy.{role}.path={member.path}: reads {key} of shape {tuple(feature.shape)}; the "
                f"environment gives {there}. See --env.obs_type, or --policy.{role}.rename_map"
            )
    cameras = {k for k, f in (config.input_features or {}).items() if f.type is FeatureType.VISUAL}
    given = {k for k, f in renamed.items() if f.type is FeatureType.VISUAL}
    if features and cameras and not (cameras <= given or (given and given <= cameras)):
        raise OptionError(
            f"--policy.{role}.path={member.path}: was trained on cameras {sorted(cameras)}; the environment "
            f"gives {sorted(given)}. Map them with --policy.{role}.rename_map"
        )
