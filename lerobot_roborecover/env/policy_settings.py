"""Everything about a policy beside its files that can change a result: what the command line made of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from lerobot_roborecover.env.identity import saved_config

NO_RESULT = (
    "pretrained_path", "pretrained_revision", "push_to_hub", "repo_id", "private", "tags", "license",
    "device",
)  # fmt: skip
"""Fields of every LeRobot configuration that change no result. The checkpoint's identity takes the place of
the first two, and the kind of device that of `device`. A field that is not named here counts."""
UNKNOWN_WEIGHTS = "server_weights"
"""The setting that says that nothing is known of a server's weights."""
OBJECT = "policy"
"""The setting that holds a policy's identity where the user gave it another name."""
_VOUCHED = (OBJECT, UNKNOWN_WEIGHTS, "server", "device")
"""Settings that may differ between the runs of one method."""


def result_fields(config: Any) -> dict[str, Any]:
    """Returns a policy's configuration as JSON-able values, without the fields that change no result."""
    import draccus

    encoded = draccus.encode(config)
    left_out = {*NO_RESULT, "type", *getattr(config, "counted_elsewhere", ())}
    return json.loads(
        json.dumps({k: v for k, v in encoded.items() if k not in left_out}, default=str, sort_keys=True)
    )


def policy_settings(
    config: Any, *, rename_map: Mapping[str, str] | None = None, portable: bool = False
) -> dict[str, Any]:
    """Returns what differs from the checkpoint's own files, for `Protocol.policy_settings`.

    Args:
        config: the policy's configuration (a LeRobot `PreTrainedConfig`), its options applied.
        rename_map: the environment's observation keys to the policy's.
        portable: whether the noise schedule is computed in float64.
    """
    found = _changed(config)
    device = getattr(config, "device", None)
    if device:
        found["device"] = str(device).partition(":")[0]
    if hasattr(config, "trial_settings"):
        found |= config.trial_settings()
    if rename_map:
        found["rename_map"] = dict(sorted(rename_map.items()))
    if portable:
        found["portable"] = True
    return _finite(found)


def settings_of_method(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings that all runs of one method share."""
    return {k: v for k, v in settings.items() if k not in _VOUCHED}


def digest_of(content: Any) -> str:
    """Returns a short hash of JSON-able content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:12]


def _changed(config: Any) -> dict[str, Any]:
    """Options that are not as saved; without a checkpoint, not as by default."""
    own, saved = result_fields(config), _as_saved(config)
    return {k: v for k, v in own.items() if k not in saved or saved[k] != v}


def _as_saved(config: Any) -> dict[str, Any]:
    import draccus

    path = getattr(config, "pretrained_path", None)
    raw = saved_config(path, getattr(config, "pretrained_revision", None))
    raw.pop("type", None)
    try:
        return result_fields(draccus.decode(type(config), raw))
    except (draccus.utils.DraccusException, ValueError, TypeError):
        # The loader says what is wrong with it; until then everything counts.
        return {}


def _finite(value: Any) -> Any:
    """The same with words for numbers that JSON lacks."""
    if isinstance(value, dict):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return str(value) if isinstance(value, float) and value - value != 0 else value
