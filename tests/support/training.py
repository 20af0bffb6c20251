"""`lerobot-train` in this process, through LeRobot's own parser and loop: imports cost more than the runs."""

from __future__ import annotations

import logging
import sys

import pytest


def lerobot_train(*args: str) -> None:
    """Runs the command as a process of its own would: with nothing of the run before."""
    from accelerate.state import AcceleratorState
    from lerobot.configs import parser
    from lerobot.scripts import lerobot_train as script

    import lerobot_roborecover.plugin  # noqa: F401 - what LeRobot's discovery imports

    AcceleratorState._reset_state(reset_partial_state=True)
    parser._config_path_args.clear()
    parser._config_yaml_overrides.clear()
    level = logging.getLogger().level
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["lerobot-train", *args])
        try:
            script.main()
        finally:
            logging.getLogger().setLevel(level)
