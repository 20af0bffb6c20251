"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os

import pytest

from lerobot_roborecover import whole
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.whole import check_new, new_file, new_folder, write_whole


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def write_file(path, text, then=None):
    with new_file(path) as temporary:
        temporary.write_text(text)
        if then is not None:
            raise then


def write_folder(root, name, then=None, meanwhile="", **options):
    with new_folder(root, **options) as folder:
        (folder / name).mkdir(parents=True)
        if meanwhile:
            (root / meanwhile).mkdir(parents=True)
        if then is not None:
            raise then


def test_a_file_appears_when_all_of_it_is_written(tmp_path):
    path = tmp_path / "deep" / "file.json"
    write_whole(path, "é")
    assert path.read_bytes() == "é".encode()
    with pytest.raises(RuntimeError, match="full"):
        write_file(path, "half", RuntimeError("full"))
    assert path.read_text("utf-8") == "é"
    with new_file(path) as temporary:
        temporary.write_text("whole")
        assert path.read_text("utf-8") == "é"
    assert path.read_text() == "whole"
    assert names(path.parent) == ["file.json"]


def test_a_block_that_writes_nothing_leaves_what_was_there(tmp_path):
    write_whole(tmp_path / "file", b"before")
    with pytest.raises(FileNotFoundError), new_file(tmp_path / "file"):
        pass
    assert (tmp_path / "file").read_bytes() == b"before"


def test_a_folder_appears_when_its_block_ends_well(tmp_path):
    root = tmp_path / "deep" / "set"
    with pytest.raises(KeyboardInterrupt):
        write_folder(root, "half", KeyboardInterrupt())
    assert names(root.parent) == []
    root.mkdir()  # an empty one is as good as none
    with new_folder(root) as folder:
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
    with pytest.raises(ScenarioError, match="not an empty folder"), new_folder(root):
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
        patched.setattr(whole.os, "replace", fails)
        with pytest.raises(OSError, match="disk is gone"):
            write_folder(root, "new", replace=True)
    assert names(root) == ["old"], "moved back"
    write_folder(root, "new", replace=True)
    assert names(root) == ["new"]
    assert names(tmp_path) == ["set"]
