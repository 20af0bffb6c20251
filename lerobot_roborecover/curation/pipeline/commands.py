"""The commands that a build amounts to: each stage's arguments, as a person would type them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.pipeline.config import ChainConfig, CollectPart, PolicyPart, RenderPart
from lerobot_roborecover.env.identity import policy_identity


class Places:
    """Where a build keeps what it makes.

    Args:
        config: its options.
    """

    def __init__(self, config: ChainConfig):
        self.root = Path(config.out)
        self.candidates = self.root / "candidates"
        self.scenarios = self.root / "scenarios"
        self.screened = self.root / "screened"
        self.validated = self.root / "validated"
        self.split = self.root / "split"
        self.rendered = self.root / "rendered"
        self.summary = self.root / "summary"
        self.old = self.root / "old"
        self.votes = Path(config.annotate.votes) if config.annotate.votes else self.root / "votes"
        self.discuss = self.root / "discuss.json"

    def collected(self, name: str) -> Path:
        """Of one way in which rollouts come about."""
        return self.root / "collect" / name


def flags(values: Mapping[str, Any], names: Iterable[str]) -> list[str]:
    """Options as arguments: those that are set, lists repeated, true ones alone."""
    given = []
    for name in names:
        value, flag = values[name], f"--{name.replace('_', '-')}"
        if value is True:
            given.append(flag)
        elif isinstance(value, list):
            given += [word for item in value for word in (flag, str(item))]
        elif value not in (None, False):
            given += [flag, str(value)]
    return given


def text(value: Any) -> str:
    """A YAML value as it is typed."""
    if isinstance(value, bool):
        return str(value).lower()
    return json.dumps(value) if isinstance(value, (list, dict)) else str(value)


def collect_command(config: ChainConfig, name: str, part: CollectPart, out: Path) -> list[str]:
    """`roborecover collect` for one part."""
    plain = (
        "expert", "name", "task", "seeds", "init_states", "draw", "seed", "reset_seed", "trials", "horizon",
        "perturb", "perturb_steps", "scene_touched", "frames", "film_every", "no_exclude", "exclude_only",
        "slots", "max_batch", "device", "watchdog", "retry_errors",
    )  # fmt: skip
    argv = ["collect", f"--env.type=roborecover_{config.platform}", "--out", str(out)]
    argv += ["--work", f"{out}.work-{_rollouts_key(part)}"]
    argv += [f"--policy.path={part.policy}"] if part.policy else []
    argv += [f"--policy.{k}={text(v)}" for k, v in part.policy_options.items()]
    argv += [f"--env.{k}={text(v)}" for k, v in part.env.items()]
    argv += ["--rename_map", json.dumps(part.rename_map)] if part.rename_map else []
    argv += ["--license", config.license] if config.license else []
    return argv + flags(vars(part), plain)


def _rollouts_key(part: CollectPart) -> str:
    """Of what decides the rollouts themselves: with other starts, rules or pictures they are used again."""
    names = (
        "expert", "name", "seed", "reset_seed", "horizon", "perturb", "perturb_steps", "max_batch", "env",
        "policy_options", "rename_map",
    )  # fmt: skip
    policy = policy_identity(part.policy) if part.policy else ""
    decisive = [policy, {name: getattr(part, name) for name in names}]
    return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()[:8]


def annotate_command(config: ChainConfig, places: Places) -> list[str]:
    """`roborecover annotate`, by programs."""
    return ["annotate", str(places.candidates), "--votes", str(places.votes), "--automatic"]


def agree_command(config: ChainConfig, places: Places) -> list[str]:
    """`roborecover agree`."""
    argv = ["agree", str(places.candidates), "--votes", str(places.votes), "--out", str(places.scenarios)]
    argv += flags(vars(config.annotate), ("votes_needed", "tolerance", "no_consensus"))
    return argv + (["--license", config.license] if config.license else [])


def screen_command(config: ChainConfig, places: Places) -> list[str]:
    """`roborecover screen`."""
    part = config.screen
    argv = ["screen", str(places.scenarios), "--out", str(places.screened)]
    for policy in part.policies:
        argv += ["--policy", f"{policy.name}={policy.path}" if policy.name else policy.path]
        argv += _of_policy(policy)
    argv += [w for k, v in part.env.items() for w in ("--env", f"{k}={text(v)}")]
    argv += ["--keep", *map(str, part.keep)] if part.keep else []
    return argv + flags(vars(part), ("trials", "max_invalid", "run_seed", "device", "slots", "max_batch"))


def _of_policy(policy: PolicyPart) -> list[str]:
    argv = [w for k, v in policy.options.items() for w in ("--policy-option", f"{policy.name}:{k}={text(v)}")]
    argv += [w for k, v in policy.env.items() for w in ("--env", f"{policy.name}:{k}={text(v)}")]
    argv += ["--deterministic", str(policy.name)] if policy.deterministic else []
    if policy.rename_map:
        argv += ["--rename-map", f"{policy.name}:{json.dumps(policy.rename_map)}"]
    return argv


def validate_command(config: ChainConfig, places: Places) -> list[str]:
    """`roborecover validate`."""
    part = config.validate
    argv = ["validate", str(places.screened), "--trials-folder", f"{places.screened}.trials"]
    argv += ["--candidates", str(places.candidates), "--out", str(places.validated)]
    argv += [w for k, v in part.env.items() for w in ("--env", f"{k}={text(v)}")]
    names = (
        "runs", "seed", "tolerance_mm", "min_ssim", "no_frames", "no_outcomes", "rejects", "workers",
        "limit_s",
    )  # fmt: skip
    return argv + flags(vars(part), names)


def split_command(config: ChainConfig, places: Places) -> list[str]:
    """`roborecover split`."""
    argv = ["split", str(places.validated), "--out", str(places.split)]
    fractions = any(v != int(v) for v in config.split.sizes.values())
    for name, size in config.split.sizes.items():
        argv += ["--split", f"{name}={float(size) if fractions else int(size)}"]
    return argv + flags(vars(config.split), ("seed", "apart"))


def render_command(config: ChainConfig, places: Places) -> list[str]:
    """`roborecover render`."""
    part = config.render or RenderPart()
    argv = ["render", str(places.split), "--out", str(places.rendered)]
    argv += [w for k, v in part.env.items() for w in ("--env", f"{k}={text(v)}")]
    return argv + flags(vars(part), ("frames", "workers"))


def publish_command(config: ChainConfig, places: Places) -> list[str]:
    """`roborecover publish`; without options, as it is to be completed."""
    argv = ["publish", str(places.split if config.render is None else places.rendered)]
    if config.publish is None:
        return [*argv, "--repo-id", "ORG/NAME"]
    return argv + flags(
        vars(config.publish), ("repo_id", "version", "private", "title", "no_pictures", "anonymise")
    )


COMMANDS: Mapping[str, Callable[[ChainConfig, Places], list[str]]] = {
    "agree": agree_command,
    "screen": screen_command,
    "validate": validate_command,
    "split": split_command,
    "render": render_command,
    "publish": publish_command,
}
"""Arguments of the stages that are one command on the result of the one before."""
