"""Configuration of the policy type `roborecover_remote`: a server that returns action chunks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import OptimizerConfig

from lerobot_roborecover.policies.not_trained import NotTrained
from lerobot_roborecover.policies.remote.errors import RemoteError

REMOTE = "roborecover_remote"
"""The policy type; `remote`, its earlier name, works as well."""
SCHEMES = {"openpi": ("ws://", "wss://"), "vla_eval": ("ws://", "wss://"), "gr00t": ("tcp://",)}
"""How an address of each protocol begins."""
_URL, _GR00T_URL = "ws://127.0.0.1:8000", "tcp://127.0.0.1:5555"


@PreTrainedConfig.register_subclass("remote")
@PreTrainedConfig.register_subclass(REMOTE)
@dataclass
class RemoteConfig(NotTrained, PreTrainedConfig):
    """A policy on a server that speaks openpi's protocol, vla-eval's, or GR00T's."""

    url: str = _URL
    """Address of the server: `ws://HOST:PORT`, or `wss://` where a proxy adds TLS; for GR00T's
    `tcp://HOST:PORT`, by default `tcp://127.0.0.1:5555`."""
    protocol: str = ""
    """`openpi`, `vla_eval` or `gr00t`; empty: the mapping's."""
    mapping: str = ""
    """What the server is sent and what it answers: a packaged mapping (`lerobot`, for `roborecover serve`;
    `openpi_libero`; ...) or the path of a YAML file."""
    name: str = ""
    """Identity of the policy in trial rows; empty: the mapping's name and the address. Name the checkpoint
    here: nothing else knows it."""
    n_action_steps: int | None = None
    """Actions executed before the server is asked again; None leaves it to the mapping."""
    connections: int = 8
    """Requests under way at once, at most."""
    timeout_s: float = 120.0
    """For an answer. The first one may include the server's compilation."""
    wait_s: float = 300.0
    """For the server to come up, before its first answer."""
    reconnect_s: float = 60.0
    """For a lost server to come back; then the trials that wait for it are begun again."""
    give_up_after: int = 3
    """Consecutive outages of the server after which the run stops; 0 never stops."""
    max_frame_mb: int = 64
    """Of an answer."""

    counted_elsewhere: ClassVar[tuple[str, ...]] = (
        "url", "name", "mapping", "connections", "timeout_s", "wait_s", "reconnect_s", "give_up_after",
        "max_frame_mb",
    )  # fmt: skip
    """Fields that change no result, or that `trial_settings` and the policy's name say by content."""

    def trial_settings(self) -> dict[str, Any]:
        """Returns what decides a trial beside the options: the mapping's content, and who the server says it
        is, which asks the server.

        Raises:
            RemoteError: the mapping cannot be used, or no server answers.
        """
        from lerobot_roborecover.policies.remote.servers import remote_settings

        return remote_settings(self)

    def __post_init__(self) -> None:
        self.device = "cpu"  # what arrives here goes to the network, not to a GPU
        super().__post_init__()
        if self.protocol not in ("", *SCHEMES):
            raise RemoteError(f"--policy.protocol={self.protocol}: not one of {', '.join(SCHEMES)}")
        if self.protocol in ("vla_eval", "gr00t") and not self.mapping:
            self.mapping = f"{self.protocol}_libero"
        if self.protocol == "gr00t" and self.url == _URL:
            self.url = _GR00T_URL
        schemes = SCHEMES[self.protocol] if self.protocol else sum(SCHEMES.values(), ())
        if not self.url.startswith(schemes):
            raise RemoteError(f"--policy.url={self.url}: write {schemes[0]}HOST:PORT")
        for name, low, high in (
            ("connections", 1, 256),
            ("timeout_s", 0.001, 10**5),
            ("wait_s", 0, 10**5),
            ("reconnect_s", 0, 10**5),
            ("give_up_after", 0, 10**6),
            ("max_frame_mb", 1, 4096),
            ("n_action_steps", 1, 10**4),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise RemoteError(f"--policy.{name}={value}: must be from {low} to {high}")

    def get_optimizer_preset(self) -> OptimizerConfig:
        """Nothing to optimise.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("a remote policy is not trained here: its weights are on the server")

    def validate_features(self) -> None:
        """Nothing: the mapping is checked against the first observation."""
