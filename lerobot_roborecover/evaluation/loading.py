"""A policy with its processors, as `lerobot-eval` loads them, behind the engine's one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.random_utils import set_seed

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.check_names import input_remedy
from lerobot_roborecover.evaluation.early_checks import check_policy_options
from lerobot_roborecover.evaluation.env_configs import RecoveryEnvConfig
from lerobot_roborecover.evaluation.lerobot_introspection import env_processors
from lerobot_roborecover.policies.checkpoint import check_checkpoint, other_width_problem
from lerobot_roborecover.policies.command_line import only_meaningful_messages, plain_parsing
from lerobot_roborecover.policies.determinism import fit_threads, make_cross_cpu_deterministic
from lerobot_roborecover.policies.load_problems import other_action_width, plain_loading
from lerobot_roborecover.policies.local_runner import LocalPolicyRunner
from lerobot_roborecover.policies.not_trained import NotTrained
from lerobot_roborecover.policies.runner import PolicyRunner, ProvidesRunner
from lerobot_roborecover.utils.plugins import register_plugins


@dataclass(frozen=True)
class HostSpec:
    """What a policy host is made from."""

    policy: PreTrainedConfig
    """The policy's configuration, options applied."""
    env: RecoveryEnvConfig
    """What is observed."""
    rename_map: Mapping[str, str] = field(default_factory=dict)
    """The env's observation keys to the policy's, as `--rename_map` of `lerobot-eval`."""
    seed: int | None = 1000
    """Seed of the run."""
    max_batch: int = 64
    """Observations per inference, at most."""
    cross_cpu_deterministic: bool = False
    """See `runner.RunnerOptions.cross_cpu_deterministic`."""


def policy_config(policy: str, options: Sequence[str] = (), device: str | None = None) -> PreTrainedConfig:
    """A checkpoint's own config.

    Args:
        policy: folder or Hub id of the checkpoint.
        options: `--name=value` or `name=value` options of it.
        device: of the policy; None takes what the config says.

    Raises:
        OptionError: there is no such checkpoint, it is not whole, or an option is not one of its policy's.
    """
    check_policy_options(policy, options)
    import lerobot.policies  # noqa: F401 - registers LeRobot's policy types

    from lerobot_roborecover.policies.interventions import configuration_intervention  # noqa: F401 - and ours
    from lerobot_roborecover.policies.remote import configuration_remote  # noqa: F401

    register_plugins()
    overrides = [f"--{o.removeprefix('--')}" for o in options]
    overrides += [f"--device={device}"] if device else []
    with plain_parsing(f"--policy.path={policy}", ValueError, TypeError, KeyError):
        config = PreTrainedConfig.from_pretrained(policy, cli_overrides=overrides)
    config.pretrained_path = Path(policy)
    return config


def load_host(spec: HostSpec) -> PolicyRunner:
    """Loads the policy and its processors.

    Raises:
        OptionError: the checkpoint is for another robot, lacks its processor files, or is not whole.
    """
    path = spec.policy.pretrained_path
    if path is not None and Path(path).is_dir():
        check_checkpoint(path)
    width = spec.env.features["action"].shape[0]
    other = other_action_width(spec.policy, width)
    if other is not None:
        raise OptionError(other_width_problem(f"--policy.path={path}", other, spec.env.type, (width,)))
    with plain_loading(f"--policy.path={path}", lambda: remedy_of(spec)):
        return _load_host(spec)


def remedy_of(spec: HostSpec) -> str:
    """What to do where the environment does not give the policy its inputs; empty where it does."""
    return input_remedy(spec.env, spec.policy.input_features or {}, spec.rename_map)


def _load_host(spec: HostSpec) -> PolicyRunner:
    register_plugins()
    torch.backends.cudnn.benchmark = True
    torch.backends.cuda.matmul.allow_tf32 = True
    set_seed(spec.seed)
    fit_threads(spec.policy.device)
    rename_map = dict(spec.rename_map)
    with only_meaningful_messages():
        policy = make_policy(cfg=spec.policy, env_cfg=spec.env, rename_map=rename_map)
    _check_trained(spec.policy, policy)
    policy.eval()
    if spec.cross_cpu_deterministic:
        make_cross_cpu_deterministic(policy)
    preprocessor, postprocessor = load_processors(policy.config, spec, spec.policy.pretrained_path)
    env_pre, env_post = env_processors(spec.env, spec.policy)
    if isinstance(policy, ProvidesRunner):
        return policy.make_host(env_pre, env_post, preprocessor, spec.max_batch)
    return LocalPolicyRunner(
        policy, env_pre, env_post, preprocessor, postprocessor, spec.max_batch,
        tracebacks=not remedy_of(spec),
    )  # fmt: skip


def _check_trained(config: PreTrainedConfig, policy: Any) -> None:
    """Refuses random weights of any policy type. `policies.metadata.check_trained` refuses LeRobot's own
    types sooner."""
    if config.pretrained_path or isinstance(config, NotTrained):
        return
    if any(parameter.requires_grad for parameter in policy.parameters()):
        raise OptionError(
            f"policy type {config.type}: its configuration names no checkpoint, so its weights are random. "
            "Give --policy.path=FOLDER_OR_HUB_ID"
        )


def load_processors(config: Any, spec: HostSpec, path: str | Path | None) -> tuple[Any, Any]:
    """A policy's pre- and postprocessor.

    Args:
        config: of the loaded policy, which knows its device.
        spec: of the host.
        path: of the checkpoint that has them; None makes new ones without statistics.
    """
    overrides = {
        "device_processor": {"device": str(config.device)},
        "rename_observations_processor": {"rename_map": dict(spec.rename_map)},
    }
    return make_pre_post_processors(
        policy_cfg=spec.policy,
        pretrained_path=None if path is None else str(path),
        pretrained_revision=spec.policy.pretrained_revision if path == spec.policy.pretrained_path else None,
        preprocessor_overrides=overrides,
    )
