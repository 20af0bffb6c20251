"""Registers RoboRecover with LeRobot. Imported by LeRobot's plugin discovery, inside `lerobot-*` programs."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from lerobot_roborecover.errors import RoboRecoverError
from lerobot_roborecover.evaluation import env_configs  # noqa: F401 - registers the env types
from lerobot_roborecover.platforms.registry import ENV_PREFIX
from lerobot_roborecover.policies import ema  # noqa: F401 - register types
from lerobot_roborecover.policies.command_line import rewrite_env_argument
from lerobot_roborecover.policies.detectors import register_detectors
from lerobot_roborecover.policies.detectors.monitor import register_monitors
from lerobot_roborecover.policies.interventions import configuration_intervention  # noqa: F401 - registers the policy
from lerobot_roborecover.policies.remote import configuration_remote  # noqa: F401 - registers the policy
from lerobot_roborecover.utils.signals import Terminated, handle, raise_terminated

register_monitors()
register_detectors()


def plain_errors(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """`sys.excepthook` that shows a refusal of ours as its message alone: the traceback would bury it."""
    if issubclass(kind, RoboRecoverError):
        print(f"error: {error}", file=sys.stderr)
    elif issubclass(kind, Terminated):
        print(f"error: ended by {error}; finished trials are kept", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


def is_ours(argv: Sequence[str]) -> bool:
    """Returns whether a command line evaluates in one of our environments."""
    return Path(argv[0]).name == "lerobot-eval" and any(
        word.startswith(f"--env.type={ENV_PREFIX}") for word in argv
    )


if sys.argv and Path(sys.argv[0]).name.startswith("lerobot-"):
    sys.argv[:] = rewrite_env_argument(sys.argv)
    sys.excepthook = plain_errors
    if is_ours(sys.argv) and threading.current_thread() is threading.main_thread():
        handle((signal.SIGTERM, signal.SIGHUP), raise_terminated)
