"""Locks on file systems that have them, and work without them where there are none."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.utils import file_locks
from lerobot_roborecover.utils.atomic_io import atomic_dir, atomic_write, remove_stale
from lerobot_roborecover.utils.file_locks import LockResult, lock_file
from lerobot_roborecover.utils.journal import AppendOnly, InUseError, Journal
from tests.support.factories import fake_dataset

NO_LOCKS = [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL]


def flock_fails(monkeypatch, number):
    """Lets every `flock` fail, as a file system without locks does."""

    def fails(file, operation):
        raise OSError(number, os.strerror(number))

    file_locks._warn_once.cache_clear()
    monkeypatch.setattr(fcntl, "flock", fails)


def names(folder):
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("number", NO_LOCKS, ids=errno.errorcode.get)
def test_a_file_system_without_locks_is_worked_on_and_warned_of_once(tmp_path, monkeypatch, caplog, number):
    flock_fails(monkeypatch, number)
    with AppendOnly(tmp_path / "a.jsonl") as file:
        file.append(b"one")
    with Journal(tmp_path / "b.jsonl", 1) as journal:
        journal.append({"vote": 1})
    with atomic_dir(tmp_path / "set") as folder:
        folder.mkdir()
    assert names(tmp_path) == ["a.jsonl", "b.jsonl", "set"]
    (warning,) = [r.getMessage() for r in caplog.records]
    assert str(tmp_path) in warning
    assert os.strerror(number) in warning


def test_split_works_where_there_are_no_locks(tmp_path, monkeypatch):
    root = fake_dataset(tmp_path / "set", 4)
    flock_fails(monkeypatch, errno.ENOLCK)
    assert main(["split", str(root), "--train", "2", "--test", "2", "--out", str(tmp_path / "out")]) == 0


def test_only_a_held_lock_means_in_use(tmp_path, monkeypatch):
    with open(tmp_path / "a", "a") as one, open(tmp_path / "a", "a") as two:
        assert lock_file(one, fcntl.LOCK_EX | fcntl.LOCK_NB) is LockResult.HELD
        assert lock_file(two, fcntl.LOCK_EX | fcntl.LOCK_NB) is LockResult.IN_USE
        with pytest.raises(InUseError, match="in use by another process"):
            AppendOnly(tmp_path / "a")
    flock_fails(monkeypatch, errno.EIO)
    with pytest.raises(OSError, match="Input/output error") as caught:
        AppendOnly(tmp_path / "a")
    assert caught.value.filename == str(tmp_path / "a")


def leftovers(root, process, made_by=None):
    """What a killed writer of a folder leaves."""
    temporary, lock = (root.with_name(f".{root.name}.{process}.{kind}") for kind in ("tmp", "lock"))
    temporary.mkdir()
    if made_by is not None:
        lock.write_text(made_by)
    return temporary, lock


def test_leftovers_are_told_from_living_writers_without_locks(tmp_path, monkeypatch):
    root = tmp_path / "set"
    host = socket.gethostname()
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        flock_fails(monkeypatch, errno.ENOLCK)
        began = Path(f"/proc/{other.pid}/stat").read_text().rpartition(")")[2].split()[19]
        living = leftovers(root, other.pid, f"{host}\n{began}")
        dead = leftovers(root, 99999999, f"{host}\n{began}")
        elsewhere = leftovers(root, 99999998, f"{host}-other\n{began}")
        old = leftovers(root, 99999997, f"{host}-other\n{began}")
        os.utime(old[1], (time.time() - 8 * 86400,) * 2)
        remove_stale(root)
        assert {p.name for p in (*living, *elsewhere)} == set(names(tmp_path))
        assert not {p.name for p in (*dead, *old)} & set(names(tmp_path))
        # A later process with the killed writer's number is not that writer.
        living[1].write_text(f"{host}\n{int(began) - 1}")
        remove_stale(root)
        assert {p.name for p in elsewhere} == set(names(tmp_path))
        other.communicate(b"\n")


def test_a_killed_writer_leaves_its_machine_and_a_living_one_is_left_alone_without_locks(
    tmp_path, monkeypatch
):
    flock_fails(monkeypatch, errno.EINVAL)
    root = tmp_path / "set"
    with atomic_dir(root) as folder:
        folder.mkdir()
        (lock,) = tmp_path.glob(".set.*.lock")
        assert lock.read_text().startswith(f"{socket.gethostname()}\n")
        kept = shutil.copy(lock, tmp_path / "kept")
    os.replace(kept, lock)
    assert remove_stale(root) == [lock], "this process writes no more"


def test_a_folder_that_cannot_be_synced_is_written_to(tmp_path, monkeypatch):
    sync = os.fsync

    def fails(number):
        if os.path.isdir(f"/proc/self/fd/{number}"):
            raise OSError(errno.EINVAL, "Invalid argument")
        sync(number)

    monkeypatch.setattr(os, "fsync", fails)
    atomic_write(tmp_path / "a", "text")
    AppendOnly(tmp_path / "b").close()
    assert names(tmp_path) == ["a", "b"]
