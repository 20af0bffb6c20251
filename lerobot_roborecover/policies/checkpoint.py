"""Checks a checkpoint before LeRobot loads it, so that what is wrong with it is one line with the remedy."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.utils.text import nearest

CONFIG_FILE = "config.json"
_STEP_FOLDER = "pretrained_model"
_WEIGHTS = (".safetensors", ".bin", ".pt", ".pth", ".ckpt")
_POINTER = b"version https://git-lfs.github.com/spec/"
_MAX_HEADER_BYTES = 10**8
"""Of the safetensors format."""


def check_checkpoint(path: str | Path, label: str = "", revision: str | None = None) -> dict[str, Any]:
    """Checks that a policy's checkpoint is there, says what it is, and that its files are whole.

    Args:
        path: folder, or Hub id.
        label: names it in messages; by default the option that names a policy.
        revision: of a Hub id.

    Returns:
        The checkpoint's configuration.

    Raises:
        OptionError: it cannot be loaded.
    """
    folder, label = Path(path), label or f"--policy.path={path}"
    if folder.is_dir():
        return check_folder(folder, label)
    if folder.exists():
        raise OptionError(f"{label}: is a file. Name the folder that holds it")
    return read_config(_hub_config(str(path), label, revision), label)


def is_other_width(kind: str, own: int, padded: int | None, widths: Sequence[int]) -> bool:
    """Whether actions of a checkpoint are of another robot than the environment's.

    Args:
        kind: type of the policy.
        own: values in its actions.
        padded: values that it pads them to, where it does.
        widths: values that the environment takes.
    """
    return kind != "xvla" and own not in (*widths, padded)  # X-VLA's 20 values are converted


def other_width_problem(label: str, own: int, env_type: str, widths: Sequence[int]) -> str:
    """What to say of a checkpoint of another robot; arguments as above."""
    return (
        f"{label}: its actions have {own} values, {env_type} takes {' or '.join(map(str, widths))}. The "
        "checkpoint is for another robot or another kind of action"
    )


def check_folder(folder: Path, label: str) -> dict[str, Any]:
    """Checks a checkpoint's folder: see `check_checkpoint`."""
    if not (folder / CONFIG_FILE).is_file():
        raise OptionError(f"{label}: the folder has no {CONFIG_FILE}. {_instead_of(folder)}")
    config = read_config(folder / CONFIG_FILE, label)
    for file in sorted(p for p in folder.iterdir() if p.suffix in _WEIGHTS and p.is_file()):
        check_file(file, label)
    return config


def nearest_path(path: str | Path) -> str:
    """Returns the path that is there and most like one that is not; empty where none is."""
    wanted = Path(path)
    hub_id = len(wanted.parts) == 2 and not str(path).startswith((".", "/", "~"))
    for part in (wanted,) if hub_id else (wanted, *wanted.parents):
        if part.parent.is_dir():
            near = nearest(part.name, [there.name for there in part.parent.iterdir()])
            return str(part.parent / near) if near else ""
    return ""


def read_config(file: Path, label: str) -> dict[str, Any]:
    """Returns a checkpoint's configuration.

    Raises:
        OptionError: it is no configuration of a policy.
    """
    raw = file.read_bytes()
    _refuse_pointer(raw, file, label)
    try:
        found = json.loads(raw)
    except (ValueError, RecursionError) as err:
        raise OptionError(f"{label}: {file.name} is not JSON ({err!s:.200}). Copy the file again") from None
    if not isinstance(found, dict) or not isinstance(found.get("type"), str):
        raise OptionError(
            f"{label}: {file.name} has no field 'type', which says what kind of policy it is. Name a folder "
            "that lerobot-train or save_pretrained wrote"
        )
    return found


def check_file(file: Path, label: str) -> None:
    """Checks that a checkpoint's file is whole, from its first bytes and, of safetensors, its size.

    Raises:
        OptionError: it is a git-LFS pointer, or cut.
    """
    size = file.stat().st_size
    with file.open("rb") as stream:
        start = stream.read(max(len(_POINTER), 8))
        _refuse_pointer(start, file, label)
        if file.suffix != ".safetensors":
            return
        length = struct.unpack("<Q", start[:8])[0] if len(start) >= 8 else _MAX_HEADER_BYTES + 1
        ends = None
        if length <= _MAX_HEADER_BYTES:
            stream.seek(8)
            ends = _ends(stream.read(length))
    if ends is None:
        raise OptionError(f"{label}: {file.name} ({size} bytes) is damaged. Copy or download it again")
    wanted = 8 + length + max(ends, default=0)
    if size != wanted:
        raise OptionError(
            f"{label}: {file.name} has {size} bytes where its header says {wanted}: it was cut. Copy or "
            "download it again"
        )


def _ends(header: bytes) -> list[int] | None:
    """Returns where tensors end, counted from the header; None where it is no header."""
    try:
        return [int(e["data_offsets"][1]) for n, e in json.loads(header).items() if n != "__metadata__"]
    except (ValueError, RecursionError, AttributeError, LookupError, TypeError):
        return None


def _refuse_pointer(start: bytes, file: Path, label: str) -> None:
    if start.startswith(_POINTER):
        raise OptionError(
            f"{label}: {file.name} is a git-LFS pointer, not the file itself. Run git lfs pull in the "
            "repository, or download the checkpoint with: hf download REPO --local-dir FOLDER"
        )


def _instead_of(folder: Path) -> str:
    """Which folder to name, from what lies in one that is no checkpoint."""
    if (folder / _STEP_FOLDER / CONFIG_FILE).is_file():
        return f"Name {folder / _STEP_FOLDER}"
    if (folder / "checkpoints").is_dir():
        return f"Name one of {_listed(_steps(folder / 'checkpoints'))}"
    if folder.parent.name == "checkpoints":
        others = [step for step in _steps(folder.parent) if step.parent != folder]
        return (
            f"It is a training step without {_STEP_FOLDER}, as an interrupted training leaves: name one of "
            f"{_listed(others)}"
        )
    there = sorted(p.name for p in folder.iterdir())[:10]
    return f"It holds {there}. A training run's checkpoint is its checkpoints/last/{_STEP_FOLDER} folder"


def _steps(checkpoints: Path) -> list[Path]:
    return sorted(p.parent for p in checkpoints.glob(f"*/{_STEP_FOLDER}/{CONFIG_FILE}"))


def _listed(paths: Sequence[Path]) -> str:
    return ", ".join(map(str, paths[-3:])) or "another run's: this one has no whole step"


def _hub_answers() -> bool:
    """Returns whether the Hub can be asked; its client tries for half a minute where there is no network."""
    import socket
    import urllib.request
    from urllib.parse import urlsplit

    from huggingface_hub import constants

    if urllib.request.getproxies():
        return True  # the proxy finds the Hub
    hub = urlsplit(constants.ENDPOINT)
    try:
        with socket.create_connection(
            (hub.hostname, hub.port or (80 if hub.scheme == "http" else 443)), timeout=5
        ):
            return True
    except OSError:
        return False


def _hub_config(name: str, label: str, revision: str | None) -> Path:
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import (
        EntryNotFoundError,
        HfHubHTTPError,
        HFValidationError,
        LocalEntryNotFoundError,
        RepositoryNotFoundError,
    )

    at = "" if revision is None else f" at {revision}"
    near = nearest_path(name)
    spelling = f"the nearest is {near}" if near else "check the spelling"
    try:
        return Path(
            hf_hub_download(name, CONFIG_FILE, revision=revision, local_files_only=not _hub_answers())
        )
    except HFValidationError:
        home = "; your shell replaces ~ only at the start of a word" if name.startswith("~") else ""
        problem = f"there is no such folder, and it is no Hub id (USER/NAME); {spelling}{home}"
    except LocalEntryNotFoundError:
        problem = (
            "there is no such folder, and the Hub cannot be reached or HF_HUB_OFFLINE is set; "
            f"{spelling}, or the network"
        )
    except RepositoryNotFoundError:
        problem = (
            f"neither a folder nor a Hub model that you may read; {spelling}, and hf auth login for a "
            "private one"
        )
    except EntryNotFoundError:
        problem = f"the Hub model has no {CONFIG_FILE}{at}: it is no LeRobot policy. Name another"
    except (HfHubHTTPError, OSError) as err:
        words = " ".join(str(err).split())
        problem = f"the Hub does not give its {CONFIG_FILE}{at} ({words:.200}). Check the revision and access"
    raise OptionError(f"{label}: no LeRobot policy there: {problem}")
