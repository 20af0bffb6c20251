"""What decides a collection, kept beside it, so that only the same one goes on in its folders."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.collect.options import CollectOptions
from lerobot_roborecover.curation.collect.starts import RolloutSpec
from lerobot_roborecover.evaluation.session import SimulatorSpec
from lerobot_roborecover.policies.metadata import PolicyMetadata, policy_metadata
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write

SETTINGS_FILE = "collect.json"


def controller_of(options: CollectOptions) -> str:
    """Returns the recorded name of the controller."""
    if options.name:
        return options.name
    if options.expert:
        return options.expert
    from lerobot_roborecover.policies.identity import policy_identity

    return policy_identity(options.policy)


def _policy_facts(options: CollectOptions) -> PolicyMetadata | None:
    """Identity of the policy, from its files and options; None for an expert."""
    if not options.policy:
        return None
    from lerobot_roborecover.evaluation.loading import policy_config

    config = policy_config(options.policy, options.policy_options, options.device)
    return policy_metadata(config, rename_map=options.rename_map)


def settings_of(
    options: CollectOptions, spec: SimulatorSpec, units: Sequence[RolloutSpec]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What decides the rollouts, and what decides the dataset."""
    policy = _policy_facts(options)
    by_init_state = any(unit.reset.init_state_index is not None for unit in units)
    rolled = {
        "platform": options.platform,
        "driver": controller_of(options),
        "policy": policy.policy if policy else "",
        "policy settings": dict(policy.policy_settings) if policy else {},
        "expert": options.expert,
        "policy options": sorted(options.policy_options),
        "env": {
            k: v for k, v in spec.decisive.items() if options.policy or k in ("control_mode", "action_mode")
        },
        "rename map": dict(options.rename_map),
        "seed": options.seed,
        "max batch": options.max_batch if options.policy else 1,
        "perturb": options.perturb,
        "perturbed steps": options.perturb_steps if options.perturb else 0,
        "horizon": options.horizon,
        "reset seed": options.starts.reset_seed if by_init_state else None,
    }
    judging = asdict(options.judging)
    judging["scene_touched_mm"] = judging.pop("min_displacement_mm")  # the name in earlier files
    rolled = json.loads(json.dumps(rolled, default=str))
    starts = {k: v for k, v in asdict(options.starts).items() if k != "reset_seed"}
    about = {
        "rollouts": rolled,
        "starts": {"tasks": list(options.tasks), **starts, "count": len(units)},
        "judging": judging,
        "frames": options.frames,
        "film_every": options.frame_stride,
    }
    return rolled, json.loads(json.dumps(about))


def claim(work: Path, rolled: Mapping[str, Any]) -> None:
    """Makes the working folder this collection's.

    Raises:
        ScenarioError: its rollouts are of other options, or it cannot be written.
    """
    path = work / SETTINGS_FILE
    try:
        work.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            found = json.loads(path.read_bytes())
            changed = differences(found, dict(rolled), ())
            if changed:
                raise ScenarioError(
                    f"{work} holds rollouts with other options ({'; '.join(changed)}). Give another "
                    "--out, or another --work"
                )
            return
        atomic_write(path, json.dumps(rolled, indent=2) + "\n")
    except (OSError, ValueError) as err:
        if isinstance(err, ScenarioError):
            raise
        raise ScenarioError(
            f"the working folder {work} cannot be used: {err}. Make room, or give another --work"
        ) from err


def differences(found: Any, wanted: dict[str, Any], nested: Sequence[str]) -> list[str]:
    """Each setting that is another one than before, in a few words.

    Args:
        found: settings as they were written down.
        wanted: as they are now.
        nested: keys whose values are compared entry by entry.
    """
    lines = []
    for key, value in wanted.items():
        there = found.get(key) if isinstance(found, dict) else None
        if key in nested:
            lines += differences(there, value, ())
        elif there != value:
            lines.append(f"{key} {_short(there)}, now {_short(value)}")
    return lines


def _short(value: Any) -> str:
    text = json.dumps(value) if not isinstance(value, str) else value or "none"
    return text if len(text) <= 60 else f"{text[:57]}..."
