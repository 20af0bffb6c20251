"""Identity of a remote policy: the content of its mapping, and its server's metadata."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from lerobot_roborecover.logs.fields import UNKNOWN_WEIGHTS, digest_of
from lerobot_roborecover.policies.remote.mapping import load_mapping
from lerobot_roborecover.policies.remote.servers import make_server

if TYPE_CHECKING:
    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig

IDENTITY = "identity"
"""Entry of a server's metadata that changes whenever its weights or settings do; `roborecover serve` gives
it."""
_TOLD = ("policy", "policy_type", "checkpoint", "checkpoint_dir", "config", "model", "model_name", "revision")
"""Entries of a server's metadata that tell something of its policy, but not its weights."""
_LONGEST = 200


def remote_settings(config: RemoteConfig) -> dict[str, Any]:
    """Returns a remote policy's part of `TrialRow.policy_settings`.

    Args:
        config: address and mapping.

    Raises:
        RemoteError: the mapping cannot be used, or no server answers.
    """
    mapping = load_mapping(config.mapping)
    server = make_server(config, mapping)
    try:
        metadata = server.reach()
    finally:
        server.close()
    found: dict[str, Any] = {"mapping": digest_of(asdict(mapping))}
    identity = metadata.get(IDENTITY)
    if isinstance(identity, str) and identity:
        return {**found, "server": _plain(identity)}
    told = {k: metadata[k] for k in _TOLD if isinstance(metadata.get(k), str | int) and metadata[k] != ""}
    if told:
        found["server"] = {k: _plain(str(v)) for k, v in told.items()}
    return {**found, UNKNOWN_WEIGHTS: "not known"}


def _plain(text: str) -> str:
    """A server's text as a log takes it."""
    return "".join(c if c.isprintable() else "\ufffd" for c in text[:_LONGEST])
