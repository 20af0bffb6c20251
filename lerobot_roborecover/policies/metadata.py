"""Reads a run's policy metadata from the parsed configuration: the policy's identity and settings.

Trial rows record it beside the scenario and the simulator.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.fields import OBJECT
from lerobot_roborecover.policies.identity import content_hash, policy_identity, policy_settings, saved_config
from lerobot_roborecover.policies.interventions.options import MEMBERS, POLICY_TYPE, InterventionFacts


@dataclass(frozen=True)
class PolicyMetadata:
    """Policy metadata of a run; None where not given."""

    policy: str = "unknown"
    """Name of the policy in trial rows."""
    policy_type: str | None = None
    """LeRobot's name of its kind."""
    n_episodes: int | None = None
    """Trials per scenario."""
    batch_size: int | None = None
    """Trials in a batch, in LeRobot's loop."""
    lerobots_batch: bool = False
    """Whether LeRobot chose that itself."""
    execution_horizon: int | None = None
    """Actions executed per inference."""
    output_dir: Path | None = None
    intervention: InterventionFacts | None = None
    """Intervention of a composite policy."""
    policy_settings: Mapping[str, Any] = field(default_factory=dict)
    """See `TrialRow.policy_settings`."""


def policy_metadata(
    config: Any,
    *,
    policy: str = "",
    identity: str = "",
    rename_map: Mapping[str, str] | None = None,
    cross_cpu_deterministic: bool = False,
    **others: Any,
) -> PolicyMetadata:
    """Facts of a run of a policy.

    Args:
        config: the policy's configuration (a LeRobot `PreTrainedConfig`), its options applied.
        policy: its name in the rows; empty takes its identity.
        identity: of a policy that is not on disk (`object_identity`).
        rename_map: the environment's observation keys to the policy's.
        cross_cpu_deterministic: see `runner.RunnerOptions.cross_cpu_deterministic`.
        others: further fields of `PolicyMetadata`.

    Raises:
        OptionError: the policy has no weights to load, see `check_trained`.
    """
    if not identity:
        check_trained(config)
    kind = getattr(config, "type", None)
    horizon = _own(config, "n_action_steps")
    path = getattr(config, "pretrained_path", None)
    name = identity or f"scratch:{kind or 'unknown'}"
    if path and not identity:
        name = policy_identity(path, getattr(config, "pretrained_revision", None))
    intervention = None
    if kind in ("roborecover_remote", "remote"):
        name = config.name or f"remote:{Path(config.mapping).stem}@{config.url}"
    elif kind == POLICY_TYPE:
        intervention = intervention_facts(config)
        name = intervention.name()
        horizon = config.base.n_action_steps
        if horizon is None:
            horizon = saved_config(config.base.path, config.base.revision).get("n_action_steps")
    settings = policy_settings(config, rename_map=rename_map, cross_cpu_deterministic=cross_cpu_deterministic)
    if policy and policy != name:
        settings[OBJECT] = name
    return PolicyMetadata(
        policy=policy or name,
        policy_type=kind,
        execution_horizon=horizon if isinstance(horizon, int) else None,
        intervention=intervention,
        policy_settings=settings,
        **others,
    )


def check_trained(config: Any) -> None:
    """Refuses a policy type of LeRobot's that would be evaluated with random weights.

    Raises:
        OptionError: its configuration names no checkpoint.
    """
    trainable = type(config).__module__.startswith("lerobot.policies.")
    if trainable and not getattr(config, "pretrained_path", None):
        raise OptionError(
            f"policy type {config.type}: its configuration names no checkpoint, so its weights would be "
            "random. Give --policy.path=FOLDER_OR_HUB_ID; in Python, give the folder or Hub id itself, or "
            "set config.pretrained_path"
        )


def intervention_facts(config: Any) -> InterventionFacts:
    """Facts of a composite policy; members that its mode does not use are left out.

    Args:
        config: its configuration (`RoboRecoverInterventionConfig`).
    """
    used = [name for name in MEMBERS if name == "base" or config.mode.endswith(name)]
    if config.monitored:
        used.append("monitor")
    settings: dict[str, Any] = {}
    for name in used:
        member = getattr(config, name)
        settings[name] = _member_identity(member) if member.path else "unknown"
        for option in ("n_action_steps", "rename_map", "threshold", "base_model"):
            value = getattr(member, option, None)
            if value not in (None, "", {}):
                settings[f"{name}_{option}"] = (
                    json.dumps(value, sort_keys=True) if isinstance(value, dict) else _by_content(str(value))
                )
    if "correction" in used:
        settings["correction_steps"] = config.correction_steps
    if config.mode == "human":
        settings["driver"] = config.controller  # the name that stored rows have
    return InterventionFacts(config.mode, config.rewind_steps, settings)


def _member_identity(member: Any) -> str:
    """A member's identity; a detector may be written as `KIND_OR_CHECKPOINT,option=value,...`."""
    head, comma, options = member.path.partition(",")
    if not comma or Path(member.path).expanduser().exists():
        return policy_identity(member.path, member.revision)
    named = [option.partition("=") for option in options.split(",")]
    told = [f"{name}{equals}{_by_content(value)}" for name, equals, value in named]
    return ",".join([policy_identity(head, member.revision), *told])


def _by_content(value: str) -> str:
    """An option's value; a hash of the content where it is the path of something."""
    path = Path(value).expanduser()
    return content_hash(path)[:12] if "/" in value and path.exists() else value


def _own(config: Any, name: str) -> Any:
    """A field of the configuration; not what a class computes under that name, which no option changes."""
    return getattr(config, name) if any(f.name == name for f in fields(config)) else None
