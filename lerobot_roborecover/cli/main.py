"""`roborecover <command>`: finds the command, parses its arguments, and turns a refusal into one line."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from types import ModuleType

from lerobot_roborecover._version import __version__
from lerobot_roborecover.cli.guard import guarded

COMMANDS = (
    "doctor",
    "check-platform",
    "demo",
    "study",
    "check-policy",
    "plan",
    "eval",
    "reproduce",
    "merge",
    "report",
    "compare",
    "fork",
    "leaderboard",
    "publish",
    "envhub",
    "pull",
    "inspect",
    "repair",
    "serve",
    "donors",
    "export-ema",
    "export-training",
    "monitor-data",
    "eval-monitor",
    "teleop",
    "collect",
    "annotate",
    "agree",
    "screen",
    "validate",
    "split",
    "render",
    "build",
)
"""Each is a module of this folder (dashes as underscores) with `HELP`, `add_arguments(parser)` and
`run(args) -> exit status`; or, where another parser reads the arguments, with `HELP` and
`pass_through(argv) -> exit status`."""


def _module(command: str) -> ModuleType:
    return importlib.import_module(f"lerobot_roborecover.cli.{command.replace('-', '_')}")


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; imports nothing heavy."""
    parser = argparse.ArgumentParser(
        prog="roborecover",
        description="Measure, and improve, how robot policies recover. Evaluation itself is lerobot-eval's: "
        "lerobot-eval --env roborecover_libero --policy.path=CHECKPOINT",
    )
    parser.add_argument("--version", action="version", version=f"roborecover {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        module = _module(name)
        command = commands.add_parser(name, help=module.HELP, description=module.HELP)
        if hasattr(module, "pass_through"):
            continue
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command.

    Args:
        argv: arguments without the program's name; by default the process's own.

    Returns:
        Exit status: 0 done; 1 done but something is wrong; 2 refused; others as `guarded`.
    """
    if argv is None:
        from lerobot_roborecover.policies import policy_thread

        policy_thread.own_process()
        status = main(sys.argv[1:])
        policy_thread.exit_process(status)
        return status
    argv = list(argv)
    command = argv[0] if argv else ""
    quiet(command)
    return guarded(f"roborecover {command}", lambda: _run(command, argv))


def _run(command: str, argv: list[str]) -> int:
    module = _module(command) if command in COMMANDS else None
    if module is not None and hasattr(module, "pass_through"):
        return module.pass_through(argv[1:])
    args = build_parser().parse_args(argv)
    return args.run(args)


def quiet(command: str) -> None:
    """Keeps libraries from burying a command's own lines in theirs, in this process and those it starts.

    Args:
        command: `study` trains with LeRobot's own commands, whose bars are the only progress there is.
    """
    os.environ.setdefault("SVT_LOG", "1")  # the video encoder: errors only, not a page a film
    if command != "study":
        os.environ.setdefault("TQDM_DISABLE", "1")


if __name__ == "__main__":
    sys.exit(main())
