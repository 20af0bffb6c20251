"""What was executed in logged trials: a file of actions for each, beside the trial log.

A row names its actions by their hash alone. With `--env.record_actions=true` the actions themselves lie in
the folder `actions` beside the log, under that hash, and are there before the row is: a trial can then be
replayed, forked (`roborecover detect fork`) and exported (`roborecover curate training-data`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_file

ACTIONS_FOLDER = "actions"
OPTION = "--env.record_actions=true"
"""What has a run record them."""


def actions_digest(actions: Iterable[np.ndarray]) -> str:
    """What a trial row calls `actions_sha256`."""
    digest = hashlib.sha256()
    for action in actions:
        digest.update(np.ascontiguousarray(action).tobytes())
    return digest.hexdigest()


def actions_path(folder: Path, row: TrialRow) -> Path:
    """File of a trial's actions, by their own hash."""
    return folder / f"{row.actions_sha256}.npy"


def put_actions(folder: Path, actions: np.ndarray, row: TrialRow) -> None:
    """Puts a trial's actions on disk, where they are not there.

    Args:
        folder: `actions` beside the log; made if need be.
        actions: (n, A), those of the row.
        row: the trial's.
    """
    path = actions_path(folder, row)
    if row.steps and not path.exists():  # trials may have the same actions
        with atomic_file(path) as file, open(file, "wb") as stream:
            np.save(stream, actions, allow_pickle=False)


def read_actions(folder: Path, row: TrialRow) -> np.ndarray:
    """A trial's actions, checked against its row.

    Args:
        folder: `actions` beside the log.
        row: the trial's.

    Returns:
        (n, A), of the type that the policy gave: replaying them is exact only in that type. As many as the
        trial took steps, and those on top that a rollback undid.

    Raises:
        ScenarioError: they are not there, or are others.
    """
    if not row.steps:
        return np.zeros((0, 0), np.float32)
    path = actions_path(folder, row)
    try:
        # Mapped first: a header may claim any size, and is refused where the file has another.
        actions = np.array(np.lib.format.open_memmap(path, mode="r"))
    except (OSError, ValueError, EOFError) as err:
        raise ScenarioError(
            f"trial {row.trial} of {row.scenario_id} by {row.policy}: its actions cannot be read ({err}). A "
            f"log alone cannot be replayed; keep {folder} beside it, or run the policy again with a new log "
            f"and {OPTION}"
        ) from None
    if actions.ndim != 2 or len(actions) < row.steps or actions_digest(actions) != row.actions_sha256:
        raise ScenarioError(f"{path} does not hold the actions of trial {row.trial} of {row.scenario_id}")
    return actions
