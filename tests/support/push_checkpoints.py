"""Screening policies for the fake simulator that do recover: checkpoints in form, the test policy plus noise
in substance."""

from __future__ import annotations

import shutil
from pathlib import Path

from tests.evaluation.test_local_engine import PushHost
from tests.support.factories import save_policy

NOISE = {"still": 0.0, "calm": 1.0, "wild": 3.0}
"""Spread of the noise on each action by the checkpoint's name."""


def push_checkpoints(folder: Path, names=tuple(NOISE)) -> list[Path]:
    """Folders that LeRobot takes for checkpoints; only their names tell them apart."""
    first = save_policy(folder / "template")
    return [Path(shutil.copytree(first, folder / name)) for name in names]


def load_push_host(config) -> PushHost:
    """In place of `trials.load.load_host`."""
    return PushHost(noise=NOISE[Path(config.policy.pretrained_path).name])
