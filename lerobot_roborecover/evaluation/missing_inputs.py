"""What to do where the environment does not give a policy an input that it was trained on."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any

from lerobot.configs import FeatureType

from lerobot_roborecover.evaluation.env_configs import RecoveryEnvConfig
from lerobot_roborecover.platforms import platform_named

BLANK = "empty_camera"
"""Part of the name of inputs that a policy fills with a blank picture by itself."""


def inputs_of(env: RecoveryEnvConfig, rename_map: Mapping[str, str]) -> dict[str, FeatureType]:
    """Kind of each of an environment's observations, by the policy's name of it.

    Args:
        env: says what is observed.
        rename_map: the env's observation keys to the policy's.
    """
    found = {}
    for key, feature in env.features.items():
        if feature.type is not FeatureType.ACTION:
            name = env.features_map.get(key, key)
            found[rename_map.get(name, name)] = feature.type
    return found


def missing_inputs(wanted: Mapping[str, Any], given: Collection[str]) -> list[str]:
    """Inputs of a policy that are not given, those aside that it fills in by itself.

    Args:
        wanted: the checkpoint's `input_features`.
        given: names of what there is.
    """
    return [key for key in wanted if key not in given and BLANK not in key]


def input_remedy(
    env: RecoveryEnvConfig,
    wanted: Mapping[str, Any],
    rename_map: Mapping[str, str],
    observed: Collection[str] | None = None,
) -> str:
    """Returns what to do: the env option that gives what is missing, the map of a camera of another name, or
    which checkpoint to take instead. Empty where nothing is missing.

    Args:
        env: what was asked for.
        wanted: the checkpoint's `input_features`.
        rename_map: the env's observation keys to the policy's.
        observed: names in a real observation, after renaming; by default what `env` says there is.
    """
    kinds = inputs_of(env, rename_map)
    given = list(kinds if observed is None else observed)
    missing = missing_inputs(wanted, given)
    if not missing:
        return ""
    for name, value in platform_named(env.platform_name).observation_options:
        other = _with_option(env, name, value)
        if other is not None and not missing_inputs(wanted, inputs_of(other, rename_map)):
            return f"give --env.{name}={json.dumps(value) if isinstance(value, bool) else value}"
    cameras = [key for key in given if kinds.get(key) is FeatureType.VISUAL]
    pictures = [key for key in missing if wanted[key].type is FeatureType.VISUAL]
    spare = [key for key in cameras if key not in wanted]
    if pictures and len(spare) >= len(pictures) and len(pictures) == len(missing):
        ours = {new: old for old, new in rename_map.items()}
        renamed = {ours.get(key, key): theirs for key, theirs in zip(spare, pictures, strict=False)}
        both = json.dumps({**{k: v for k, v in rename_map.items() if v not in spare}, **renamed})
        return (
            f"if the views are the same, give --rename_map='{both}'; else take a checkpoint that was trained "
            f"on {', '.join(cameras)}"
        )
    has = ", ".join(sorted(kinds if observed is None else given)) or "nothing"
    return (
        f"no option of {env.type} gives {', '.join(missing)}: take a checkpoint whose inputs are among what "
        f"it gives ({has})"
    )


def _with_option(env: RecoveryEnvConfig, name: str, value: Any) -> RecoveryEnvConfig | None:
    """The same env type with another option; None where it has the option so, or refuses it."""
    if not hasattr(env, name) or getattr(env, name) == value:
        return None
    base = getattr(env, "base", None)
    try:
        return type(env)(**({} if base is None else {"base": base}), **{name: value})
    except Exception:  # a platform's own configuration may refuse in any way
        return None
