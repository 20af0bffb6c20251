"""A run as a record: what `roborecover eval` is to do, made in a program and handed over as a file.

The file is a configuration as `--config_path` of `roborecover eval` and `lerobot-eval` reads it, so that the
run can be done again, or changed, by hand.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.registry import env_type_of
from lerobot_roborecover.utils.atomic_io import atomic_write


@dataclass(frozen=True)
class RunSpec:
    """One run: who, on what, how often, and where results go."""

    platform: str
    env: Mapping[str, Any]
    """Options of the recovery env type: `scenarios`, `revision`, `split`, `select`, `start`, `trial_log` and
    the platform's own."""
    policy: Mapping[str, Any]
    """A checkpoint's `path`, or the `type` of a policy that is put together from others; and its options.
    Members are mappings of their own."""
    trials: int
    """Per scenario."""
    output_dir: Path
    seed: int = 1000
    rename_map: Mapping[str, str] = field(default_factory=dict)
    """The environment's observation keys to the policy's."""
    runner: Mapping[str, Any] = field(default_factory=dict)
    """Of `runner.RunnerOptions`: `slots`, `max_batch`, `cross_cpu_deterministic`, ..."""

    def config(self) -> dict[str, Any]:
        """The configuration, in LeRobot's words; plain values only."""
        own = platform_named(self.platform)
        found = {
            "env": {"type": env_type_of(own.env_name or own.name), **own.env_defaults, **self.env},
            "policy": dict(self.policy),
            "eval": {"n_episodes": self.trials},
            "seed": self.seed,
            "rename_map": dict(self.rename_map),
            "runner": dict(self.runner),
            "output_dir": self.output_dir,
        }
        return _plain({key: value for key, value in found.items() if value not in ({}, None)})

    def write(self, path: Path) -> list[str]:
        """Writes the file.

        Returns:
            The command that runs it: `roborecover` with these arguments.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, yaml.safe_dump(self.config(), sort_keys=False, allow_unicode=True).encode())
        return ["eval", f"--config_path={path}"]

    def command_line(self) -> str:
        """The same run as a command line, for people to read and to copy."""
        options = [f"--{name}={value}" for name, value in _flat(self.config())]
        return shlex.join(["roborecover", "eval", *options])


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    return str(value) if isinstance(value, Path) else value


def _flat(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in config.items():
        if isinstance(value, Mapping) and name != "rename_map":
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", str(value).lower() if isinstance(value, bool) else value
