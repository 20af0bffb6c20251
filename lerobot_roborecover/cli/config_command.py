"""Runs a command whose options are a LeRobot configuration; refuses what it can before LeRobot's import."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence

from lerobot_roborecover.cli.config_help import help_text
from lerobot_roborecover.evaluation.early_checks import CommandLine, ConfigSource, join_values


def run_config_command(
    source: ConfigSource,
    main: str,
    argv: Sequence[str],
    about: str,
    check: Callable[[CommandLine], None] | None = None,
) -> int:
    """Prints the help, or refuses what is wrong; else hands the command line to LeRobot's parser.

    Args:
        source: which options there are.
        main: `module:function` that takes the command line.
        argv: arguments without the command's name.
        about: what the command does, for its help.
        check: refuses more of what the command line says.

    Returns:
        Exit status.

    Raises:
        OptionError: naming what is wrong, and what is nearest to it.
    """
    words = join_values(argv)
    if {"-h", "--help"} & set(words):
        print(help_text(source, about, [word for word in words if word not in ("-h", "--help")]))
        return 0
    line = CommandLine(source, words)
    line.check()
    if check is not None:
        check(line)
    module, _, function = main.partition(":")
    return getattr(importlib.import_module(module), function)(words)
