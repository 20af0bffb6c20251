"""Who is evaluated, and how much of it: what the trial rows say of a run beside its scenarios and its
simulators. Read from a policy's parsed configuration, whoever parsed it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from lerobot_roborecover.env.identity import policy_identity, saved_config
from lerobot_roborecover.env.intervention_options import MEMBERS, POLICY_TYPE, InterventionFacts


@dataclass(frozen=True)
class RunFacts:
    """Facts of a run; None where nobody says."""

    policy: str = "unknown"
    """Who is evaluated, in the rows' words."""
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
    """Of a composite policy."""


def facts_of(config: Any, *, policy: str = "", **others: Any) -> RunFacts:
    """Facts of a run of a policy.

    Args:
        config: the policy's configuration (a LeRobot `PreTrainedConfig`), its options applied.
        policy: its name in the rows; empty takes what it was loaded from.
        others: further fields of `RunFacts`.
    """
    kind = getattr(config, "type", None)
    horizon = _own(config, "n_action_steps")
    path = getattr(config, "pretrained_path", None)
    name = policy_identity(str(path)) if path else f"scratch:{kind or 'unknown'}"
    intervention = None
    if kind == "remote":
        name = config.name or f"remote:{config.mapping}@{config.url}"
    elif kind == POLICY_TYPE:
        intervention = intervention_facts(config)
        name = intervention.name()
        horizon = config.base.n_action_steps
        if horizon is None:
            horizon = saved_config(config.base.path).get("n_action_steps")
    return RunFacts(
        policy=policy or name,
        policy_type=kind,
        execution_horizon=horizon if isinstance(horizon, int) else None,
        intervention=intervention,
        **others,
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
        settings[name] = policy_identity(member.path) if member.path else "unknown"
        for option in ("n_action_steps", "rename_map", "threshold", "base_model"):
            value = getattr(member, option, None)
            if value not in (None, "", {}):
                settings[f"{name}_{option}"] = json.dumps(value) if isinstance(value, dict) else str(value)
    if "correction" in used:
        settings["correction_steps"] = config.correction_steps
    if config.mode == "human":
        settings["driver"] = config.driver
    return InterventionFacts(config.mode, config.rewind_steps, settings)


def _own(config: Any, name: str) -> Any:
    """A field of the configuration; not what a class computes under that name, which no option changes."""
    return getattr(config, name) if any(f.name == name for f in fields(config)) else None
