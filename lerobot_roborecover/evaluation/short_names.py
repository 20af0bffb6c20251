"""Short names of options that `roborecover eval` has and `lerobot-eval` does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

ALIASES = {
    "engine": "runner.engine",
    "videos": "runner.videos",
    "limit-seconds": "runner.limit_seconds",
    "sequential": "runner.sequential",
    "shard": "env.shard",
    "retry": "runner.retry",
}
"""Long name of each."""
JSON = {"json": "check.json=true"}
"""Of `roborecover check policy`: what the switch stands for."""
ALONE = "alone"
"""Value of `--runner.sequential` that compares with no other log."""


def long_names(argv: Sequence[str], short: Mapping[str, str]) -> list[str]:
    """All arguments under their long names; `--sequential` without a log is given its value.

    Args:
        argv: arguments.
        short: long names.
    """
    found = [_long_name(argument, short) for argument in argv]
    for k, name in enumerate(found):
        if name == "--runner.sequential" and (k + 1 == len(found) or found[k + 1].startswith("--")):
            found[k] = f"{name}={ALONE}"
    return found


def _long_name(argument: str, short: Mapping[str, str]) -> str:
    """`--videos=3` as `--runner.videos=3`, and the like."""
    name, _, value = argument.removeprefix("--").partition("=")
    if not argument.startswith("--") or name not in short:
        return argument
    return f"--{short[name]}={value}" if value else f"--{short[name]}"
