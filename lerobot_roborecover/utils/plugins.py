"""Registers the types of installed LeRobot plugins (`lerobot_env_*`, `lerobot_policy_*` and their like)."""

from __future__ import annotations

import logging

_registered = False


def register_plugins() -> None:
    """Imports every installed plugin, once per process, so that its types can be named.

    LeRobot's own function logs a line for each plugin. Here only a plugin that cannot be imported is logged,
    as one line.
    """
    global _registered
    if _registered:
        return
    _registered = True  # before the imports: our own plugin is among them, and what it imports may ask again
    from lerobot.utils.import_utils import register_third_party_plugins

    root = logging.getLogger()  # LeRobot logs to the root logger
    root.addFilter(_keep_failures)
    try:
        register_third_party_plugins()
    finally:
        root.removeFilter(_keep_failures)


def _keep_failures(record: logging.LogRecord) -> bool:
    if (
        not str(record.msg)
        .lower()
        .startswith(("imported third-party plugin", "could not import third-party"))
    ):
        return True
    if record.levelno < logging.WARNING:
        return False
    error = record.exc_info[1] if record.exc_info else None
    record.msg = f"{record.getMessage()} ({type(error).__name__}: {' '.join(str(error).split()):.300})"
    record.args, record.exc_info, record.levelno, record.levelname = (), None, logging.WARNING, "WARNING"
    return True
