"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time

import pytest

from lerobot_roborecover.errors import InUseError
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils import atomic_io
from lerobot_roborecover.utils.atomic_io import atomic_dir, atomic_file, atomic_write, check_new, remove_stale
from lerobot_roborecover.utils.file_locks import lock_file


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def write_file(path, text, then=None):
    with atomic_file(path) as temporary:
        temporary.write_text(text)
        if then is not None:
            raise then


def write_folder(root, name, then=None, meanwhile="", **options):
    with atomic_dir(root, **options) as folder:
        (folder / name).mkdir(parents=True)
        if meanwhile:
            (root / meanwhile).mkdir(parents=True)
        if then is not None:
            raise then


def test_a_file_appears_when_all_of_it_is_written(tmp_path):
    path = tmp_path / "deep" / "file.json"
    atomic_write(path, "é")
    assert path.read_bytes() == "é".encode()
    with pytest.raises(RuntimeError, match="full"):
        write_file(path, "half", RuntimeError("full"))
    assert path.read_text("utf-8") == "é"
    with atomic_file(path) as temporary:
        temporary.write_text("whole")
        assert path.read_text("utf-8") == "é"
    assert path.read_text() == "whole"
    assert names(path.parent) == ["file.json"]


def test_who_replaces_a_file_at_the_same_moment_is_not_in_the_way(tmp_path, monkeypatch):
    """Two workers keep the same snapshot: neither trial is to end with an error."""
    path, replace = tmp_path / "key.snapshot", os.replace
    atomic_write(path, "first")

    def meanwhile(old, new):
        monkeypatch.setattr(os, "replace", replace)
        # While this one holds the file to replace it.
        code = "from pathlib import Path; from lerobot_roborecover.utils import atomic_io as io; "
        code += f"io.atomic_write(Path({str(path)!r}), 'of the other worker')"
        subprocess.run([sys.executable, "-c", code], check=True)
        assert path.read_text() == "of the other worker"
        replace(old, new)

    monkeypatch.setattr(os, "replace", meanwhile)
    atomic_write(path, "of this worker")
    assert path.read_text() == "of this worker"
    assert names(tmp_path) == ["key.snapshot"]


def test_a_file_that_a_process_has_for_itself_is_not_replaced(tmp_path):
    path = tmp_path / "trials.jsonl"
    path.write_text("row\n")
    with open(path) as log:
        lock_file(log, fcntl.LOCK_EX)
        with pytest.raises(InUseError, match="in use by another process and is not replaced"):
            atomic_write(path, "")
    assert path.read_text() == "row\n"


def test_a_block_that_writes_nothing_leaves_what_was_there(tmp_path):
    atomic_write(tmp_path / "file", b"before")
    with pytest.raises(FileNotFoundError), atomic_file(tmp_path / "file"):
        pass
    assert (tmp_path / "file").read_bytes() == b"before"


def test_a_folder_appears_when_its_block_ends_well(tmp_path):
    root = tmp_path / "deep" / "set"
    with pytest.raises(KeyboardInterrupt):
        write_folder(root, "half", KeyboardInterrupt())
    assert names(root.parent) == []
    root.mkdir()  # an empty one is as good as none
    with atomic_dir(root) as folder:
        folder.mkdir()
        (folder / "whole").touch()
        assert names(root) == []
    assert names(root) == ["whole"]
    assert names(root.parent) == ["set"]


@pytest.mark.parametrize("make", ["a file", "a folder with something", "a link"])
def test_what_is_there_is_not_written_over(tmp_path, make):
    root, elsewhere = tmp_path / "set", tmp_path / "elsewhere"
    elsewhere.mkdir()
    if make == "a file":
        root.touch()
    elif make == "a link":
        root.symlink_to(elsewhere)
    else:
        (root / "inner").mkdir(parents=True)
    with pytest.raises(ScenarioError, match="not an empty folder"):
        check_new(root)
    with pytest.raises(ScenarioError, match="not an empty folder"), atomic_dir(root):
        pytest.fail("the block ran")


def test_what_appears_during_the_block_is_not_written_over(tmp_path):
    root = tmp_path / "set"
    with pytest.raises(OSError, match="not empty"):
        write_folder(root, "ours", meanwhile="theirs")
    assert names(root) == ["theirs"]


def test_an_earlier_folder_is_replaced_only_by_a_whole_one(tmp_path, monkeypatch):
    root = tmp_path / "set"
    (root / "old").mkdir(parents=True)
    with pytest.raises(RuntimeError, match="half"):
        write_folder(root, "new", RuntimeError("half"), replace=True)
    assert names(root) == ["old"]

    replace = os.replace

    def fails(source, target):
        if str(source).endswith(".tmp"):
            raise OSError("the disk is gone")
        replace(source, target)

    with monkeypatch.context() as patched:
        patched.setattr(atomic_io.os, "replace", fails)
        with pytest.raises(OSError, match="disk is gone"):
            write_folder(root, "new", replace=True)
    assert names(root) == ["old"], "moved back"
    write_folder(root, "new", replace=True)
    assert names(root) == ["new"]
    assert names(tmp_path) == ["set"]


KILLED = """
import os, signal, sys
from pathlib import Path
from lerobot_roborecover.utils import atomic_io
from lerobot_roborecover.utils.atomic_io import atomic_dir
with atomic_dir(Path(sys.argv[1])) as outer, atomic_dir(outer) as inner:
    inner.mkdir()
    (inner / "half").touch()
    print("up", flush=True)
    if sys.argv[2] == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    sys.stdin.read()
"""


def writer(root, how):
    return subprocess.Popen(
        [sys.executable, "-c", KILLED, str(root), how], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )


def test_what_a_killed_writer_left_is_taken_away_by_the_next_and_a_living_one_is_left_alone(tmp_path):
    root, other = tmp_path / "set", tmp_path / "set.old"
    other.mkdir()
    with writer(root, "kill") as killed:
        assert killed.wait() == -signal.SIGKILL
    # Two folders are announced, and only the inner one is made.
    left = names(tmp_path)
    assert [n.split(".")[-1] for n in left] == ["lock", "tmp", "lock", "old"]
    with writer(root, "wait") as living:
        assert living.stdout.readline() == b"up\n"
        there = names(tmp_path)
        assert len(there) == 4
        assert not set(left[:3]) & set(there), "the killed writer's are gone"
        assert remove_stale(root) == []
        assert names(tmp_path) == there, "the living writer's are left alone"
        living.communicate(b"")
    assert names(tmp_path) == ["set", "set.old"]
    assert names(root) == ["half"]


def test_an_earlier_folder_comes_back_when_its_writer_was_killed_in_between(tmp_path):
    old = tmp_path / ".set.99999999.old"
    old.mkdir()
    (old / "earlier").touch()
    write_folder(tmp_path / "set2", "new")
    assert old.exists(), "another folder's"
    with pytest.raises(ScenarioError, match="not an empty folder"):
        write_folder(tmp_path / "set", "new")
    assert names(tmp_path / "set") == ["earlier"]
    write_folder(tmp_path / "set", "new", replace=True)
    assert names(tmp_path) == ["set", "set2"]


def test_old_leftovers_of_a_file_are_taken_away(tmp_path):
    dead, young, alive = (tmp_path / f".file.{n}.tmp" for n in (99999999, 99999998, 1))
    for path in (dead, young, alive):
        path.touch()
    for path in (dead, alive):
        os.utime(path, (time.time() - 7200,) * 2)
    atomic_write(tmp_path / "file", "new")
    assert names(tmp_path) == [alive.name, young.name, "file"]
