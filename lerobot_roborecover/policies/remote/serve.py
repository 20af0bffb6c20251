"""`roborecover serve`: a checkpoint, loaded as LeRobot loads it, behind a policy server."""

import asyncio
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from lerobot.configs import parser
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.utils.utils import init_logging

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.fields import digest_of
from lerobot_roborecover.policies.checkpoint import check_checkpoint
from lerobot_roborecover.policies.command_line import run_with_arguments
from lerobot_roborecover.policies.determinism import fit_threads
from lerobot_roborecover.policies.load_problems import plain_loading
from lerobot_roborecover.policies.metadata import policy_metadata
from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig
from lerobot_roborecover.policies.remote.keys import API_KEY, api_key, check_key
from lerobot_roborecover.policies.remote.served import ServedPolicy
from lerobot_roborecover.policies.remote.server import PolicyServer, ServeOptions, is_loopback

logger = logging.getLogger(__name__)


@dataclass
class ServeConfig:
    """Options of `roborecover serve`."""

    policy: PreTrainedConfig | None = None
    host: str = "127.0.0.1"
    """Address to listen on. Beyond the loopback, ROBORECOVER_API_KEY must be set, here and at the client."""
    port: int = 8000
    """To listen on; 0 takes a free one."""
    max_batch: int = 64
    """Requests inferred together, at most."""
    batch_delay_ms: float = 5.0
    """How long a request waits for others to share its batch."""
    max_frame_mb: int = 64
    """Of a request."""
    max_sessions: int = 256
    """Trials whose history is kept at once."""
    max_connections: int = 256
    """Clients connected at once."""
    max_pending_mb: int = 256
    """Of requests of all clients that are not answered yet; one frame always fits."""
    certfile: str = ""
    """TLS certificate chain, PEM: clients then say wss:// (--certfile CERT --keyfile KEY)."""
    keyfile: str = ""
    """Its private key, PEM."""
    insecure: bool = False
    """Let every client that reaches --host use the policy, without a key."""
    rename_map: dict[str, str] = field(default_factory=dict)
    """The client's observation keys to the policy's, as in `lerobot-eval`."""

    def __post_init__(self):
        path = parser.get_path_arg("policy")
        if path:
            check_checkpoint(path)
            overrides = parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or [])
            self.policy = PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
            self.policy.pretrained_path = Path(path)

    def check(self) -> PreTrainedConfig:
        """Refuses what cannot be used.

        Returns:
            `policy`.

        Raises:
            OptionError: naming the option, its value and what it may be.
        """
        if self.policy is None or self.policy.pretrained_path is None:
            raise OptionError("no policy: give a checkpoint with --policy.path=FOLDER_OR_HUB_ID")
        for name, low, high in (
            ("port", 0, 65535),
            ("max_batch", 1, 4096),
            ("batch_delay_ms", 0, 10_000),
            ("max_frame_mb", 1, 4096),
            ("max_sessions", 1, 10**6),
            ("max_connections", 1, 10_000),
            ("max_pending_mb", 1, 2**20),
        ):
            if not low <= getattr(self, name) <= high:
                raise OptionError(f"--{name}={getattr(self, name)}: must be from {low} to {high}")
        if self.keyfile and not self.certfile:
            raise OptionError(f"--keyfile={self.keyfile}: the key of which certificate? Give --certfile")
        key = api_key()
        if key is not None:
            check_key(key)
        if key is None and not is_loopback(self.host) and not self.insecure:
            raise OptionError(
                f"--host={self.host}: any client that reaches it could use the policy. Set {API_KEY} here "
                "and at the client; or listen on 127.0.0.1 and use an SSH tunnel; or say --insecure=true"
            )
        return self.policy

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Lets LeRobot's parser read `--policy.path`."""
        return ["policy"]


def load_served(config: PreTrainedConfig, rename_map: dict[str, str], max_batch: int) -> ServedPolicy:
    """The policy and its own processors, as `lerobot-eval` loads them, without an environment.

    Args:
        config: with `pretrained_path`.
        rename_map: observation keys.
        max_batch: requests inferred together, at most.

    Raises:
        OptionError: the checkpoint is an adapter, or a policy without weights.
    """
    if isinstance(config, RemoteConfig):
        raise OptionError("--policy.path: this is a remote policy; serve the policy itself")
    if config.use_peft:
        raise OptionError("--policy.path: an adapter; merge it into its base policy first")
    torch.backends.cudnn.benchmark = True
    torch.backends.cuda.matmul.allow_tf32 = True
    fit_threads(config.device)
    path = str(config.pretrained_path)
    with plain_loading(f"--policy.path={path}"):
        policy = get_policy_class(config.type).from_pretrained(
            path, config=config, revision=config.pretrained_revision
        )
    policy.to(config.device)
    policy.eval()
    overrides = {
        "device_processor": {"device": str(config.device)},
        "rename_observations_processor": {"rename_map": rename_map},
    }
    with plain_loading(f"--policy.path={path}"):
        pre, post = make_pre_post_processors(
            config,
            pretrained_path=path,
            pretrained_revision=config.pretrained_revision,
            preprocessor_overrides=overrides,
        )
    return ServedPolicy(policy, pre, post, rename_map, max_batch)


def public_name(path: str) -> str:
    """What clients are told of a checkpoint: a Hub id, or a folder's own name without where it lies.

    Args:
        path: of `--policy.path`.
    """
    return Path(path).resolve().name if Path(path).exists() else path


def serve(cfg: ServeConfig) -> int:
    """Serves until it is interrupted; see `main`."""
    policy = cfg.check()
    pending_mb = max(cfg.max_pending_mb, cfg.max_frame_mb)
    options = ServeOptions(
        cfg.host, cfg.port, cfg.batch_delay_ms / 1e3, cfg.max_frame_mb * 2**20, cfg.max_sessions,
        cfg.max_connections, pending_mb * 2**20, api_key(), cfg.certfile, cfg.keyfile,
    )  # fmt: skip
    facts = policy_metadata(policy, rename_map=cfg.rename_map)  # before loading fills in anything
    told = digest_of([facts.policy, facts.policy_settings])
    served = load_served(policy, cfg.rename_map, cfg.max_batch)
    name = public_name(str(policy.pretrained_path))
    server = PolicyServer(served, name, options, f"{name}@{told}")
    if policy.type == "xvla":
        logger.warning(
            "lerobot-eval gives X-VLA processors of its own on LIBERO, which a client does not know: its "
            "scores through a server are not those of --policy.path"
        )

    def ready(port: int) -> None:
        host = f"[{cfg.host}]" if ":" in cfg.host else cfg.host
        scheme = "wss" if cfg.certfile else "ws"
        print(f"serving {policy.type} at {scheme}://{host}:{port} (Ctrl-C ends)", flush=True)

    asyncio.run(server.run(ready))
    print(f"stopped after {server.served} inferences", flush=True)
    return 0


def main(argv: Sequence[str]) -> int:
    """Runs with a command line.

    Args:
        argv: arguments without the program's and the command's name.
    """
    init_logging()
    logging.getLogger("websockets").setLevel(logging.WARNING)
    return run_with_arguments(serve, "roborecover-serve", argv)
