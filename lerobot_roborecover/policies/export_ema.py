"""A plain checkpoint with the averaged weights, from one that was trained with `roborecover_ema_adamw`.

The optimizer knows its parameters by number. Our configurations give it all of the policy's, in the policy's
own order (`use_policy_training_preset: false`), which is how numbers become names again; every shape is
checked.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.policies.checkpoint import check_folder
from lerobot_roborecover.utils.atomic_io import atomic_dir, check_new

_TRAINING_STATE = Path("training_state") / "optimizer_state.safetensors"
_PRETRAINED = "pretrained_model"


def export_ema(checkpoint: Path, out: Path) -> int:
    """Writes the averaged weights as a checkpoint of their own, with its processors.

    Args:
        checkpoint: `checkpoints/<step>` of a training run, or its `pretrained_model`.
        out: folder to write; must be new or empty.

    Returns:
        How many of the policy's parameters were averaged; the others (frozen ones) are as trained.

    Raises:
        OptionError: there is no average there, or it is not of that policy.
        ScenarioError: `out` is not new or empty.
    """
    from safetensors import safe_open

    folder = checkpoint.parent if checkpoint.name == _PRETRAINED else checkpoint
    model, state = folder / _PRETRAINED, folder / _TRAINING_STATE
    for path in (model / "config.json", state):
        if not path.is_file():
            raise OptionError(
                f"{path} is missing: {checkpoint} is not a checkpoint that lerobot-train can resume. Give "
                "the folder checkpoints/<step> (or checkpoints/last) of the run"
            )
    check_new(out)
    _check_optimizer(folder)
    policy = _load(model)
    with safe_open(state, framework="pt") as file:
        count = _copy(policy, file, state)
    with atomic_dir(out) as folder:
        shutil.copytree(
            model, folder, ignore=shutil.ignore_patterns("model.safetensors", "train_config.json")
        )
        policy.save_pretrained(folder)
    return count


def _check_optimizer(folder: Path) -> None:
    path = folder / _PRETRAINED / "train_config.json"
    try:
        optimizer = json.loads(path.read_text())["optimizer"]["type"]
    except (OSError, ValueError, KeyError, TypeError):
        return  # the shadow itself decides
    if optimizer != "roborecover_ema_adamw":
        raise OptionError(
            f"{folder} was trained with the optimizer {optimizer!r}, which keeps no average. Train with "
            "policies/train/correction_*.yaml, or use the checkpoint as it is"
        )


def _load(model: Path) -> Any:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies import get_policy_class

    from lerobot_roborecover.utils.plugins import register_plugins

    check_folder(model, str(model))
    register_plugins()
    config = PreTrainedConfig.from_pretrained(model)
    if config.use_peft:
        raise OptionError(f"{model} is a PEFT adapter; its average cannot be exported. Train without --peft")
    config.device = "cpu"
    return get_policy_class(config.type).from_pretrained(model, config=config)


def _copy(policy: Any, file: Any, path: Path) -> int:
    """Puts the shadows in place of the weights; their number."""
    import torch

    from lerobot_roborecover.policies.ema import SHADOW

    weights = dict(enumerate(policy.named_parameters()))
    found = [key for key in file.keys() if key.endswith(f"/{SHADOW}")]  # noqa: SIM118 - not a dict
    if not found:
        raise OptionError(f"{path} holds no average; it was not trained with roborecover_ema_adamw")
    with torch.no_grad():
        for key in found:
            index = int(key.split("/")[1])
            shadow = file.get_tensor(key)
            if index not in weights or weights[index][1].shape != shadow.shape:
                name = weights[index][0] if index in weights else "no parameter"
                raise OptionError(
                    f"{path}: average {index} has shape {tuple(shadow.shape)}, which is not that of {name}. "
                    "Train with use_policy_training_preset: false, so that the order is the policy's own"
                )
            weights[index][1].copy_(shadow)
    return len(found)
