"""Which protocol a policy server is spoken to in, and the identity of a remote policy: the content of its
mapping, and its server's metadata."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from lerobot_roborecover.logs.fields import UNKNOWN_WEIGHTS, digest_of
from lerobot_roborecover.policies.remote.configuration_remote import SCHEMES, RemoteConfig
from lerobot_roborecover.policies.remote.connection import RemoteServer, ServerOptions
from lerobot_roborecover.policies.remote.errors import MappingError, RemoteError
from lerobot_roborecover.policies.remote.keys import api_key
from lerobot_roborecover.policies.remote.mapping import Mapping, load_mapping
from lerobot_roborecover.policies.remote.vla_eval import EpisodeServer
from lerobot_roborecover.utils.text import install_command

if TYPE_CHECKING:
    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig

IDENTITY = "identity"
"""Entry of a server's metadata that changes whenever its weights or settings do; `roborecover serve` gives
it."""
_TOLD = ("policy", "policy_type", "checkpoint", "checkpoint_dir", "config", "model", "model_name", "revision")
"""Entries of a server's metadata that tell something of its policy, but not its weights."""
_LONGEST = 200


def make_server(config: RemoteConfig, mapping: Mapping) -> RemoteServer:
    """A server, not connected to yet.

    Args:
        config: address, times and limits.
        mapping: whose protocol is spoken.

    Raises:
        MappingError: the mapping is for another protocol, or another kind of address.
        RemoteError: an extra is not installed, or the key cannot be used.
    """
    if config.protocol not in ("", mapping.protocol):
        raise MappingError(
            f"--policy.mapping={config.mapping} is for {mapping.protocol}; --policy.protocol="
            f"{config.protocol} needs one of its own"
        )
    schemes = SCHEMES[mapping.protocol]
    if not config.url.startswith(schemes):
        raise MappingError(
            f"--policy.mapping={config.mapping} is for {mapping.protocol}; --policy.url={config.url} is "
            f"not: write {schemes[0]}HOST:PORT"
        )
    greetings = {"openpi": mapping.reset.message if mapping.reset else None, "vla_eval": mapping.episode}
    return _server_class(mapping.protocol)(
        ServerOptions(
            config.url,
            timeout_s=config.timeout_s,
            wait_s=config.wait_s,
            reconnect_s=config.reconnect_s,
            connections=config.connections,
            max_frame_bytes=config.max_frame_mb * 2**20,
            api_key=api_key(),
            greeting=greetings.get(mapping.protocol),
        )
    )


def _server_class(protocol: str) -> type[RemoteServer]:
    if protocol == "vla_eval":
        return EpisodeServer
    if protocol == "gr00t":
        try:
            from lerobot_roborecover.policies.remote.gr00t import CallServer
        except ModuleNotFoundError as err:
            raise RemoteError(
                f"--policy.protocol=gr00t needs {err.name}: {install_command('gr00t')}"
            ) from err
        return CallServer
    return RemoteServer


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
