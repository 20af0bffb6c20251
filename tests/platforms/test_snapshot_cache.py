"""Files that several workers keep at once: the second to come is not in trouble."""

from __future__ import annotations

import fcntl

import numpy as np

from lerobot_roborecover.logs.row import actions_digest, actions_path, put_actions
from lerobot_roborecover.replay.handoff import SnapshotCache
from lerobot_roborecover.utils.file_locks import lock_file
from tests.support.trial_rows import trial_row

STATE = "ab" * 32


def test_a_snapshot_that_another_worker_is_keeping_costs_no_trial(tmp_path):
    first = SnapshotCache(folder=tmp_path)
    first.put("key", b"snapshot", STATE)
    with open(tmp_path / "key.snapshot", "rb") as file:
        lock_file(
            file, fcntl.LOCK_EX
        )  # as `atomic_write` of the other worker does while it replaces the file
        second = SnapshotCache(folder=tmp_path)
        second.put("key", b"snapshot", STATE)
        assert second.get("key") == (b"snapshot", STATE)
    assert SnapshotCache(folder=tmp_path).get("key") == (b"snapshot", STATE)


def test_a_full_disk_costs_no_trial(tmp_path):
    (tmp_path / "folder").write_text("in the way")
    cache = SnapshotCache(folder=tmp_path / "folder")
    cache.put("key", b"snapshot", STATE)
    assert cache.get("key") == (b"snapshot", STATE)


def test_actions_that_another_process_is_putting_cost_no_trial(tmp_path, monkeypatch):
    actions = np.ones((3, 2), np.float32)
    row = trial_row(0, steps=3, actions_sha256=actions_digest(actions))
    path, save, others = actions_path(tmp_path, row), np.save, []

    def meanwhile(file, *args, **options):
        save(file, *args, **options)
        save(path, actions)
        others.append(path.open("rb"))
        lock_file(others[0], fcntl.LOCK_EX)

    monkeypatch.setattr(np, "save", meanwhile)
    put_actions(tmp_path, actions, row)
    others[0].close()
    assert (np.load(path) == actions).all()
