"""A command whose options are a LeRobot configuration."""

from __future__ import annotations

from collections.abc import Callable

from lerobot.configs import parser


def run_with_arguments[C](command: Callable[[C], int]) -> int:
    """Runs a command with the configuration that the process's own arguments ask for, as LeRobot reads them.

    Args:
        command: its parameter's annotation is the class of the configuration itself, not its name.

    Returns:
        What the command returned: an exit code.
    """
    # LeRobot types the wrapped command as the bare one, which cannot be called without a configuration.
    wrapped: Callable[..., int] = parser.wrap()(command)
    return wrapped()
