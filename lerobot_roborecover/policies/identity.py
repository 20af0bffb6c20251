"""Identity of a policy: the content of its files, and every option that can change a result.

One changed byte of a checkpoint makes another policy.

A local folder is hashed whole. A Hub checkpoint is named by its commit. A policy object is hashed with its
weights, buffers, configuration and processors.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lerobot_roborecover.logs.row import ACTIONS_FOLDER

ADAPTER_FILE = "adapter_config.json"
NO_RESULT = (
    "pretrained_path", "pretrained_revision", "push_to_hub", "repo_id", "private", "tags", "license",
    "device",
)  # fmt: skip
"""Fields of every LeRobot configuration that change no result. The checkpoint's identity takes the place of
the first two, and the kind of device that of `device`. A field that is not named here counts."""
_LENGTH = 12
"""Digits of a hash in a policy's name."""
_NEVER_LOADED = ("train_config.json", "eval_info.json", "LICENSE", "__pycache__")
"""Names within a checkpoint's folder that no loader reads. Everything else counts."""
_NEVER_LOADED_SUFFIXES = (".md", ".jsonl", ".log", ".mp4", ".png", ".jpg", ".gif", ".html")
"""Kinds of files that no loader reads: cards, logs, pictures."""
_RESULTS = ("trials.jsonl", "eval_info.json")
"""Files of an evaluation's output folder, which may lie within the checkpoint's."""
_NO_SOURCES = ("pretrained_path", "repo_id", "name_or_path", "_name_or_path")
"""Fields of a saved configuration that name a place which nothing is loaded from any more."""
_SETTLED_NS = 2 * 10**9
"""A file that changed less than this ago may change again within one tick of its file system's clock."""
_hashes: dict[tuple[str, int, int, int], str] = {}


def policy_identity(path: str | Path, revision: str | None = None) -> str:
    """Returns how trial rows name a checkpoint.

    Args:
        path: a local folder, named by its own name and the hash of every file that it is loaded from (an
            adapter's base, and local folders that its configuration names, included); or a Hub id, named by
            its commit.
        revision: commit, tag or branch of a Hub id.
    """
    text = str(path)
    local = Path(text).expanduser()
    if local.is_dir():
        return f"{_folder_name(local)}@{content_hash(local)[:_LENGTH]}"
    folder = snapshot_folder(text, revision)
    if folder is None:
        return text if revision is None else f"{text}@{revision}"
    base = _adapter_base(folder)
    return f"{text}@{folder.name[:_LENGTH]}" + (f"+{base}" if base else "")


def policy_name(path: str | Path) -> str:
    """Returns a checkpoint's name in `policy_identity`, without its hash."""
    local = Path(path).expanduser()
    return _folder_name(local) if local.is_dir() else str(path)


def content_hash(path: Path) -> str:
    """Returns the SHA-256 of a file, or of a checkpoint's folder with all that it is loaded from."""
    return _content_hash(path, frozenset())


def file_sha256(file: Path) -> str:
    """Returns the SHA-256 of a file's whole content. A process reads an unchanged file once."""
    stat = file.stat()
    key = (str(file.resolve()), stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)
    found = _hashes.get(key)
    if found is None:
        with open(file, "rb") as stream:
            found = hashlib.file_digest(stream, "sha256").hexdigest()
        if time.time_ns() - max(stat.st_mtime_ns, stat.st_ctime_ns) > _SETTLED_NS:
            _hashes[key] = found
    return found


def object_identity(policy: Any, processors: tuple[Any, ...] = ()) -> str:
    """Returns the name of a policy that is not on disk: its type, and a hash of everything that it holds.

    Args:
        policy: a torch module. All of its weights and buffers count, and its configuration.
        processors: its pre- and postprocessor, whose settings and statistics count.
    """
    digest = hashlib.sha256()
    # `state_dict` leaves out buffers that are not persistent.
    tensors = {**dict(policy.named_buffers()), **policy.state_dict()}
    _add_tensors(digest, tensors)
    config = getattr(policy, "config", None)
    if config is not None:
        _add_json(digest, result_fields(config))
    for processor in processors:
        for step in getattr(processor, "steps", (processor,)):
            digest.update(f"{type(step).__module__}.{type(step).__qualname__}".encode())
            if hasattr(step, "get_config"):
                _add_json(digest, {k: v for k, v in step.get_config().items() if k != "device"})
            if hasattr(step, "state_dict"):
                _add_tensors(digest, step.state_dict())
    kind = getattr(config, "type", type(policy).__name__)
    return f"{kind}@{digest.hexdigest()[:_LENGTH]}"


def result_fields(config: Any) -> dict[str, Any]:
    """Returns a policy's configuration as JSON-able values, without the fields that change no result."""
    import draccus

    encoded = draccus.encode(config)
    left_out = {*NO_RESULT, "type", *getattr(config, "counted_elsewhere", ())}
    return json.loads(
        json.dumps({k: v for k, v in encoded.items() if k not in left_out}, default=str, sort_keys=True)
    )


def policy_settings(
    config: Any, *, rename_map: Mapping[str, str] | None = None, cross_cpu_deterministic: bool = False
) -> dict[str, Any]:
    """Returns what differs from the checkpoint's own files, for `Protocol.policy_settings`.

    Args:
        config: the policy's configuration (a LeRobot `PreTrainedConfig`), its options applied.
        rename_map: the environment's observation keys to the policy's.
        cross_cpu_deterministic: whether the noise schedule is computed in float64.
    """
    found = _changed(config)
    device = getattr(config, "device", None)
    if device:
        found["device"] = str(device).partition(":")[0]
    if hasattr(config, "trial_settings"):
        found |= config.trial_settings()
    if rename_map:
        found["rename_map"] = dict(sorted(rename_map.items()))
    if cross_cpu_deterministic:
        found["portable"] = True  # the name that stored rows have
    return _finite(found)


def saved_config(path: str | Path | None, revision: str | None = None) -> dict[str, Any]:
    """Returns a checkpoint's configuration as it was saved; empty where there is none to read."""
    folder = snapshot_folder(str(path), revision) if path else None
    if folder is None:
        return {}
    return _read_json(folder / "config.json")


def snapshot_folder(path: str, revision: str | None = None) -> Path | None:
    """Returns the folder that a policy is loaded from: a local one, or one in the Hub cache, which gets the
    configuration's current commit first. None where there is no such checkpoint."""
    folder = Path(path).expanduser()
    if folder.is_dir():
        return folder
    if "/" not in path:  # no Hub id: the kind of a detector
        return None
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    for name in ("config.json", ADAPTER_FILE):
        try:
            return Path(hf_hub_download(path, name, revision=revision)).parent
        except (HFValidationError, HfHubHTTPError, LocalEntryNotFoundError, OSError):
            continue
    return None


def _content_hash(path: Path, above: frozenset[Path]) -> str:
    """The hash of a file or folder; `above` are the folders whose configurations led here."""
    if path.is_file():
        return file_sha256(path)
    above |= {path.resolve()}
    digest = hashlib.sha256()
    for file in sorted(_loaded_files(path), key=lambda f: f.relative_to(path).as_posix()):
        digest.update(f"{file.relative_to(path).as_posix()} {file_sha256(file)}\n".encode())
        if file.suffix == ".json" and file.parent == path:
            config = _read_json(file)
            for source in _named_sources(config) if file.name == "config.json" or "steps" in config else ():
                if source.resolve() not in above:
                    digest.update(f"{file.name} names {_content_hash(source, above)}\n".encode())
    base = _adapter_base(path, above)
    digest.update(base.encode())
    return digest.hexdigest()


def _loaded_files(folder: Path) -> Iterator[Path]:
    """Files of a checkpoint's folder that a loader may read."""
    for path in folder.iterdir():
        name = path.name
        if name.startswith(".") or name in _NEVER_LOADED or path.suffix in _NEVER_LOADED_SUFFIXES:
            continue
        if path.is_dir():
            if path.is_symlink() and folder.resolve().is_relative_to(path.resolve()):
                continue  # a link to a folder above
            results = any((path / result).exists() for result in _RESULTS)
            if not results and not (name == ACTIONS_FOLDER and any(folder.glob("*.jsonl"))):
                yield from _loaded_files(path)
        elif path.is_file():
            yield path


def _named_sources(value: Any) -> Iterator[Path]:
    """Existing files and folders that a configuration names by a path with a slash: a tokenizer's, a
    backbone's."""
    if isinstance(value, dict):
        for key, item in value.items():
            if key not in _NO_SOURCES:
                yield from _named_sources(item)
    elif isinstance(value, list):
        for item in value:
            yield from _named_sources(item)
    elif isinstance(value, str) and "/" in value and len(value) < 4096 and "\0" not in value:
        path = Path(value).expanduser()
        if path.is_dir() or path.is_file():
            yield path


def _adapter_base(folder: Path, above: frozenset[Path] = frozenset()) -> str:
    """The identity of the policy that an adapter was trained on; empty where the folder holds no adapter."""
    config = _read_json(folder / ADAPTER_FILE)
    base = config.get("base_model_name_or_path")
    if not isinstance(base, str) or not base:
        return ""
    local = Path(base).expanduser()
    if local.is_dir():
        return "" if local.resolve() in above else _content_hash(local, above)[:_LENGTH]
    return policy_identity(base, config.get("revision"))


def _folder_name(folder: Path) -> str:
    folder = folder.resolve()
    if folder.name == "pretrained_model":  # lerobot-train's checkpoints/<step>/pretrained_model
        return "/".join(folder.parts[-4:-1])
    return folder.name


def _read_json(file: Path) -> dict[str, Any]:
    try:
        loaded = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return loaded if isinstance(loaded, dict) else {}


def _add_tensors(digest: hashlib._Hash, tensors: dict[str, Any]) -> None:
    import torch

    for name, tensor in sorted(tensors.items()):
        value = torch.as_tensor(tensor).detach().cpu().contiguous()
        digest.update(f"{name} {tuple(value.shape)} {value.dtype}\n".encode())
        digest.update(memoryview(value.reshape(-1).view(torch.uint8).numpy()))


def _add_json(digest: hashlib._Hash, value: Any) -> None:
    digest.update(json.dumps(value, sort_keys=True, default=str).encode())


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
