"""Files of a detector's checkpoint, in a folder or on the Hub."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.policies.checkpoint import check_file
from lerobot_roborecover.policies.detectors.interface import DetectorError

WEIGHTS_FILE = "model.safetensors"
CONFIG_FILE = "config.json"
TRAINED_ON_FILE = "monitor_training.json"
"""Beside the weights: which scenarios the training set held, so that no evaluation uses them again."""


def find_file(path: str | Path, name: str, revision: str | None = None) -> Path:
    """A checkpoint's file; downloaded where the checkpoint is on the Hub.

    Raises:
        DetectorError: there is no such checkpoint or file.
    """
    folder = Path(path).expanduser()
    if folder.is_dir():
        if not (folder / name).is_file():
            there = sorted(p.name for p in folder.iterdir())[:20]
            raise DetectorError(
                f"{folder} has no {name}: it is not a complete checkpoint; it holds {there}. A "
                "training run's checkpoint is its checkpoints/last/pretrained_model folder"
            )
        return _whole(folder / name, str(path))
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    try:
        return _whole(Path(hf_hub_download(str(path), name, revision=revision)), str(path))
    except (HFValidationError, HfHubHTTPError, LocalEntryNotFoundError) as err:
        raise DetectorError(
            f"checkpoint {str(path)!r} is neither a folder nor a Hub model with {name} "
            f"({type(err).__name__}). Check the spelling, the revision, and `hf auth login` for a private one"
        ) from err


def _whole(file: Path, label: str) -> Path:
    """The file, checked: a pointer, or one that was cut, would be an error of torch's or LeRobot's."""
    try:
        check_file(file, label)
    except OptionError as err:
        raise DetectorError(str(err)) from None
    return file


def read_trained_on(path: str | Path, revision: str | None = None) -> dict[str, Any]:
    """Which scenarios a checkpoint was trained on; empty where it does not say."""
    try:
        found = json.loads(find_file(path, TRAINED_ON_FILE, revision).read_text())
    except (DetectorError, ValueError):
        return {}
    good = isinstance(found, dict) and isinstance(found.get("scenarios"), dict)
    return found if good else {}
