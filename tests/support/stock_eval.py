"""`lerobot-eval` in this process."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import pytest


def lerobot_eval(folder: Path, *args: str) -> Path:
    """Runs it through LeRobot's own parser and loop; returns the output folder."""
    from lerobot.scripts import lerobot_eval as script

    import lerobot_roborecover.plugin as plugin

    argv = ["lerobot-eval", *args, "--policy.device=cpu", f"--output_dir={folder}"]
    level = logging.getLogger().level
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", plugin.rewrite_env_argument(argv))
            script.eval_main()
    finally:
        logging.getLogger().setLevel(level)
    return folder
