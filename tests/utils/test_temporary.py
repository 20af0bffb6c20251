"""Temporary folders: gone with their process, and with the next run where that was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile

import pytest

from lerobot_roborecover.utils.temporary import TemporaryFolder, remove_abandoned

HOLD = """
import sys
from lerobot_roborecover.utils.temporary import TemporaryFolder
folder = TemporaryFolder("snapshots")
(folder.path / "half").write_bytes(b"x")
print(folder.path, flush=True)
sys.stdin.read()
"""


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    return tmp_path


def holder():
    """A process that has a temporary folder, and ends once its standard input is closed."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    return process, process.stdout.readline().strip()


def test_it_is_removed_with_its_process_or_by_the_next_run_after_a_kill(temporary):
    (temporary / "roborecover-somebody-elses").mkdir()
    living, its = holder()
    killed, left = holder()
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert os.path.exists(left), "nothing could run in the killed process"
    with TemporaryFolder("next") as folder:
        assert folder.is_dir()
        assert not os.path.exists(left)
        assert os.path.exists(os.path.join(its, "half")), "its process lives"
    assert not folder.exists()
    living.communicate("")
    assert sorted(p.name for p in temporary.iterdir()) == ["roborecover-somebody-elses"]


def test_a_folder_that_another_process_took_for_abandoned_is_made_anew(temporary, monkeypatch):
    import fcntl

    lock = fcntl.flock
    taken = []

    def late(number, how):
        if not taken:  # another process looks between the making of the folder and its lock
            taken.append(True)
            assert len(remove_abandoned(temporary)) == 1
        lock(number, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with TemporaryFolder("late") as folder:
        assert folder.is_dir()


def test_a_folder_that_is_gone_before_it_is_opened_is_made_anew(temporary, monkeypatch):
    make, taken = tempfile.mkdtemp, []

    def early(*args):
        path = make(*args)
        if not taken:  # another process looks between the making of the folder and its opening
            taken.append(path)
            assert len(remove_abandoned(temporary)) == 1
        return path

    monkeypatch.setattr(tempfile, "mkdtemp", early)
    with TemporaryFolder("early") as folder:
        assert folder.is_dir()
        assert str(folder) != taken[0]


def test_without_locks_nothing_counts_as_abandoned(temporary, monkeypatch):
    import errno
    import fcntl

    left = temporary / "roborecover-left.tmp"
    left.mkdir()

    def none(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", none)
    with TemporaryFolder("there") as folder:
        assert folder.is_dir()
    assert left.is_dir()
    assert not folder.exists()
