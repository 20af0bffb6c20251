"""A command whose options are a LeRobot configuration."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, redirect_stdout
from typing import Any, TextIO, cast

from draccus.utils import DecodingError, ParsingError
from lerobot.configs import parser

from lerobot_roborecover.errors import OptionError, RoboRecoverError
from lerobot_roborecover.platforms.registry import ENV_PREFIX
from lerobot_roborecover.utils.plugins import register_plugins


def rewrite_env_argument(argv: list[str]) -> list[str]:
    """Reads `--env roborecover_…` as `--env.type=roborecover_…`.

    LeRobot's parser (draccus) refuses a bare name for a choice class. Only our own names, and only the
    argument list, are touched.

    Args:
        argv: a command line, program name first.

    Returns:
        The command line to parse instead.
    """
    out = argv[:1]
    index = 1
    while index < len(argv):
        argument = argv[index]
        value = None
        if argument == "--env" and index + 1 < len(argv):
            value = argv[index + 1]
        elif argument.startswith("--env="):
            value = argument.removeprefix("--env=")
        if value is not None and value.startswith(ENV_PREFIX):
            out.append(f"--env.type={value}")
            index += 2 if argument == "--env" else 1
        else:
            out.append(argument)
            index += 1
    return out


def run_with_arguments[C](command: Callable[[C], int], program: str, argv: Sequence[str]) -> int:
    """Runs a command with the configuration that arguments ask for, as LeRobot reads them. Types of installed
    plugins can be named.

    Args:
        command: its parameter's annotation is the class of the configuration itself, not its name.
        program: name that the parser's messages begin with.
        argv: arguments without it.

    Returns:
        What the command returned: an exit code.
    """
    register_plugins()
    # LeRobot types the wrapped command as the bare one, which cannot be called without a configuration.
    wrapped: Callable[..., int] = parser.wrap()(command)
    with only_meaningful_messages(), process_arguments(program, argv), plain_parsing():
        return wrapped()


@contextmanager
def only_meaningful_messages() -> Generator[None]:
    """Leaves out the messages of LeRobot's that mean nothing in a recovery evaluation."""
    loggers = [logging.getLogger(name) for name in ("lerobot.configs.eval", "lerobot.policies.factory", None)]
    added = [one for one in loggers if _says_something not in one.filters]
    for one in added:
        one.addFilter(_says_something)
    try:
        yield
    finally:
        for one in added:
            one.removeFilter(_says_something)


_SAY_NOTHING = (
    "No pretrained path was provided",  # of our own policy types; random weights are refused (metadata.py)
    "No job name provided",
    "You are instantiating a policy from scratch and its features are parsed from an environment",
    "Loading weights from local directory",
)
"""How messages of LeRobot's begin that mean nothing in a recovery evaluation."""


def _says_something(record: logging.LogRecord) -> bool:
    return not str(record.msg).startswith(_SAY_NOTHING)


class _PlainOutput:
    """Standard output without the lines that say nothing."""

    def __init__(self, stream: TextIO):
        self._stream, self._line = stream, ""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        *lines, self._line = (self._line + text).split("\n")
        for line in lines:
            if not line.startswith(_SAY_NOTHING):
                self._stream.write(f"{line}\n")
        return len(text)

    def flush(self) -> None:
        self._stream.write(self._line)
        self._line = ""
        self._stream.flush()


@contextmanager
def plain_output() -> Generator[None]:
    """Leaves out what LeRobot prints and means nothing here; the rest reaches standard output."""
    plain = _PlainOutput(sys.stdout)
    with redirect_stdout(cast(TextIO, plain)):
        try:
            yield
        finally:
            plain.flush()


@contextmanager
def plain_parsing(label: str = "", *others: type[Exception]) -> Generator[None]:
    """Raises what a configuration refuses as one line, which draccus hides behind errors of its own.

    Args:
        label: what the message begins with.
        others: exceptions that count as refusals, too.

    Raises:
        RoboRecoverError: as the configuration raised it.
        OptionError: in the words of what LeRobot or draccus raised.
    """
    try:
        yield
    except (ParsingError, DecodingError, *others) as err:
        causes: list[BaseException] = [err]
        while causes[-1].__cause__ is not None:
            causes.append(causes[-1].__cause__)
        for cause in causes:
            if isinstance(cause, RoboRecoverError):
                raise cause from None
        # A plain ParsingError says "Couldn't instantiate class ..." and nothing of the reason.
        reason = next((cause for cause in causes if type(cause) is not ParsingError), err)
        words = " ".join(str(reason).split())
        raise OptionError(f"{label}: {words:.500}" if label else f"{words:.500}") from err


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
