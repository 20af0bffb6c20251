"""Why a checkpoint cannot be evaluated, in words, where LeRobot's own say little."""

from __future__ import annotations

from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import ACTION


def load_remedy(err: Exception) -> str:
    """What to do about an error that loading raised; empty where its own message is the best there is."""
    text = str(err).lower()
    if "processor" in text and (
        "not found" in text or "migrat" in text or isinstance(err, FileNotFoundError)
    ):
        return (
            "the checkpoint has no processor files (policy_preprocessor.json, policy_postprocessor.json). "
            "Take them from where it was trained, or migrate an old one: python -m "
            "lerobot.processor.migrate_policy_normalization --pretrained-path CHECKPOINT"
        )
    if "feature" in text and "mismatch" in text:
        return (
            "the checkpoint's cameras have other names than the env's: give --rename_map, or it is for "
            "another robot"
        )
    return ""


def other_action_width(config: PreTrainedConfig, width: int) -> int | None:
    """The action width of a checkpoint for another robot; None where it fits, or does not say.

    Args:
        config: the checkpoint's configuration, before `make_policy` replaces its output by the env's.
        width: the env's.
    """
    feature = (getattr(config, "output_features", None) or {}).get(ACTION)
    if feature is None or getattr(config, "type", "") == "xvla":  # X-VLA's 20 values are converted
        return None
    own = int(feature.shape[0])
    return None if own in (width, getattr(config, "max_action_dim", width)) else own
