"""A command whose options are a LeRobot configuration."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager

from lerobot.configs import parser


def run_with_arguments[C](command: Callable[[C], int], program: str, argv: Sequence[str]) -> int:
    """Runs a command with the configuration that arguments ask for, as LeRobot reads them.

    Args:
        command: its parameter's annotation is the class of the configuration itself, not its name.
        program: name that the parser's messages begin with.
        argv: arguments without it.

    Returns:
        What the command returned: an exit code.
    """
    # LeRobot types the wrapped command as the bare one, which cannot be called without a configuration.
    wrapped: Callable[..., int] = parser.wrap()(command)
    with process_arguments(program, argv):
        return wrapped()


@contextmanager
def process_arguments(program: str, argv: Sequence[str]) -> Generator[None]:
    """Puts arguments in the place of the process's own, which are back afterwards.

    LeRobot's parser reads the process's, in several places: `parser.wrap` when a function is called,
    `parser.get_path_arg` and its like when a configuration is made. It keeps in its module what a
    `--config_path` said of policies, where the next configuration of the process would take it for its own.

    Args:
        program: the first of them.
        argv: the others.
    """
    before = sys.argv[:]
    sys.argv[:] = [program, *argv]
    try:
        yield
    finally:
        sys.argv[:] = before
        parser._config_path_args.clear()
        parser._config_yaml_overrides.clear()
