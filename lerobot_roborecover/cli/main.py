"""`roborecover COMMAND`: finds the command, parses its arguments, and turns a refusal into one line."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NoReturn

from lerobot_roborecover._version import __version__
from lerobot_roborecover.cli.arguments import Parser, add_options, check_checkpoints, read_options
from lerobot_roborecover.cli.output import guarded
from lerobot_roborecover.cli.tree import (
    COMMANDS,
    GROUPS,
    Call,
    Command,
    find_call,
    group_help,
    in_group,
    nearest_name,
    overview,
)


def command_module(name: str) -> Any:
    """Imports a command's module, or the object that stands for it (`Command.module`)."""
    module, _, inner = name.partition(":")
    found = importlib.import_module(f"lerobot_roborecover.cli.{module}")
    return getattr(found, inner) if inner else found


def command_parser(call: Call) -> Parser:
    """Returns the parser of one command, which says the name that was typed."""
    module = command_module(call.module)
    parser = Parser(prog=f"roborecover {call.name}", description=module.HELP)
    _add_arguments(parser, module)
    return parser


def build_parser() -> Parser:
    """Returns one parser of all commands, for tables and for shell completion; imports nothing heavy."""
    parser = Parser(prog="roborecover", description="How robot policies recover.")
    parser.add_argument("--version", action="version", version=f"roborecover {__version__}")
    top = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in in_group(""):
        _add_command(top, command)
    for group, summary in GROUPS.items():
        inner = top.add_parser(group, help=summary).add_subparsers(required=True, metavar="COMMAND")
        for command in in_group(group):
            _add_command(inner, command)
    return parser


def _add_command(commands: Any, command: Command) -> None:
    module = command_module(command.module)
    _add_arguments(commands.add_parser(command.word, help=command.summary, description=module.HELP), module)


def _add_arguments(parser: Parser, module: Any) -> None:
    if hasattr(module, "OPTIONS"):
        add_options(parser, module.OPTIONS)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command.

    Args:
        argv: arguments without the program's name; by default the process's own.

    Returns:
        Exit status: 0 done; 1 done but something is wrong; 2 refused; others as `guarded`.
    """
    if argv is None:
        from lerobot_roborecover.policies import watchdog

        watchdog.own_process()
        status = main(sys.argv[1:])
        watchdog.exit_process(status)
        return status
    call = find_call(argv)
    if call is None:
        return guarded("roborecover", lambda: _without_command(argv))
    quiet(call.module)
    return guarded(f"roborecover {call.name}", lambda: _run(call))


def _run(call: Call) -> int:
    if call.note:
        with suppress(OSError):  # standard error may be closed
            print(call.note, file=sys.stderr)
    module = command_module(call.module)
    if hasattr(module, "pass_through"):
        return module.pass_through(list(call.rest))
    args = command_parser(call).parse_args(call.rest)
    options = read_options(module.OPTIONS, args)
    check_checkpoints(options)
    return module.run(options)


class _ListParser(Parser):
    """Takes `--help` and `--version` where no command is named; its help is a text of ours."""

    def __init__(self, prog: str, text: str) -> None:
        super().__init__(prog=prog, usage=f"{prog} COMMAND ...")
        self.text = text
        self.add_argument("--version", action="version", version=f"roborecover {__version__}")
        self.add_argument("command", nargs="?")
        self.add_argument("rest", nargs="...")

    def format_help(self) -> str:
        return self.text


def _without_command(argv: Sequence[str]) -> NoReturn:
    """Prints help, or names the commands that are nearest to what was typed; exits."""
    group = argv[0] if argv and argv[0] in GROUPS else ""
    parser = _ListParser(f"roborecover {group}".strip(), group_help(group) if group else overview())
    word = parser.parse_args(argv[1:] if group else argv).command
    if not word:
        parser.print_help(sys.stderr)
        parser.exit(2)
    near = nearest_name(word, group)
    parser.error(
        f'there is no command "{word[:80]}"; '
        + (f'the nearest is "roborecover {near}"' if near else f'"{parser.prog} --help" lists them')
    )


def quiet(module: str) -> None:
    """Keeps libraries from burying a command's own lines in theirs, in this process and those it starts.

    Args:
        module: of the command. `study` trains with LeRobot's own commands, whose bars are the only progress
            there is.
    """
    os.environ.setdefault("SVT_LOG", "1")  # the video encoder: errors only, not a page a video
    if module != "study":
        os.environ.setdefault("TQDM_DISABLE", "1")


__all__ = ["COMMANDS", "build_parser", "command_module", "command_parser", "main"]


if __name__ == "__main__":
    sys.exit(main())
