"""How trial rows name a policy: by content, so that a folder's new contents are a new policy."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

_SAMPLE_BYTES = 2**20
_HASH_WHOLE_BELOW = 256 * 2**20
_SAMPLED_VALUES = 1024


def policy_identity(path: str) -> str:
    """How trial rows name a checkpoint: a local folder by name and content hash, a Hub checkpoint by id and
    commit."""
    folder = _snapshot_folder(path)
    if folder is None:
        return path
    if not Path(path).is_dir():
        return f"{path}@{folder.name[:12]}"
    digest = hashlib.sha256()
    for name in ("config.json", "model.safetensors", "adapter_model.safetensors"):
        file = folder / name
        if file.is_file():
            digest.update(name.encode())
            _hash_file(file, digest)
    name = folder.resolve().name
    if name == "pretrained_model":  # lerobot-train's checkpoints/<step>/pretrained_model
        name = "/".join(folder.resolve().parts[-4:-1])
    return f"{name}@{digest.hexdigest()[:12]}"


def weights_identity(policy: Any) -> str:
    """Names a policy that is not on disk: its type, and a hash of its weights.

    Args:
        policy: a torch module; of every tensor some thousand values are looked at, spread over it, which
            training changes.
    """
    digest = hashlib.sha256()
    for name, tensor in sorted(policy.state_dict().items()):
        flat = tensor.detach().flatten()
        sample = flat[:: max(flat.numel() // _SAMPLED_VALUES, 1)].double().cpu().numpy()
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode() + sample.tobytes())
    kind = getattr(policy.config, "type", type(policy).__name__)
    return f"{kind}@{digest.hexdigest()[:12]}"


def saved_config(path: str | None) -> dict[str, Any]:
    """A checkpoint's configuration; empty where there is none to read."""
    folder = _snapshot_folder(path) if path else None
    if folder is None:
        return {}
    try:
        loaded = json.loads((folder / "config.json").read_text())
    except (OSError, ValueError):
        return {}
    return loaded if isinstance(loaded, dict) else {}


def _snapshot_folder(path: str) -> Path | None:
    """The folder a policy is loaded from: local, or in the Hub cache that LeRobot has just filled."""
    folder = Path(path)
    if folder.is_dir():
        return folder
    from huggingface_hub import try_to_load_from_cache
    from huggingface_hub.errors import HFValidationError

    try:
        cached = try_to_load_from_cache(path, "config.json")
    except HFValidationError:
        return None
    return Path(cached).parent if isinstance(cached, str) else None


def _hash_file(file: Path, digest: hashlib._Hash) -> None:
    """Whole content of small files; size, start, end and 62 samples between of large ones (a second, not a
    minute)."""
    size = file.stat().st_size
    with open(file, "rb") as stream:
        if size <= _HASH_WHOLE_BELOW:
            digest.update(stream.read())
            return
        digest.update(str(size).encode())
        for index in range(64):
            stream.seek((size - _SAMPLE_BYTES) * index // 63)
            digest.update(stream.read(_SAMPLE_BYTES))
