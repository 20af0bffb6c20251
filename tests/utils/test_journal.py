"""Files of lines that only grow: the one implementation beneath every log and journal."""

from __future__ import annotations

import os
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils import journal
from lerobot_roborecover.utils.journal import (
    AppendOnly,
    InUseError,
    Journal,
    append_records,
    complete_lines,
    plain_records,
)


@given(
    lines=st.lists(st.binary(max_size=30).map(lambda b: b.replace(b"\n", b"")), max_size=6),
    rest=st.binary(max_size=30).map(lambda b: b.replace(b"\n", b"")),
)
def test_complete_lines_stay_and_a_cut_one_goes(tmp_path_factory, lines, rest):
    path = tmp_path_factory.mktemp("log") / "a.jsonl"
    path.write_bytes(b"".join(line + b"\n" for line in lines) + rest)
    with AppendOnly(path) as file:
        assert list(file.lines()) == [line + b"\n" for line in lines]
        assert file.cut() == len(rest)
        file.append(b"new", b"newer")
        assert list(file.lines()) == [line + b"\n" for line in (*lines, b"new", b"newer")]


def test_a_leftover_longer_than_a_block_goes(tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_bytes(b"one\n" + b"x" * 200_000)
    with AppendOnly(path) as file:
        assert file.cut() == 200_000
    assert path.read_bytes() == b"one\n"
    path.write_bytes(b"y" * 200_000)
    with AppendOnly(path) as file:
        assert file.cut() == 200_000
    assert path.read_bytes() == b""


def test_a_line_of_endless_length_is_not_read_whole(tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_bytes(b"x" * 1000)
    with open(path, "rb") as file:
        assert len(next(complete_lines(file, 10))) == 12
        assert list(complete_lines(file)) == []


def test_one_process_at_a_time(tmp_path):
    path = tmp_path / "new" / "a.jsonl"
    with AppendOnly(path):
        with pytest.raises(InUseError, match=r"a\.jsonl is in use"):
            AppendOnly(path)
        with pytest.raises(ScenarioError, match="in use by another process; stop that one first"):
            Journal(path, 1)
    AppendOnly(path).close()


def test_a_file_whose_lines_are_replaced_is_locked_at_every_moment(tmp_path, monkeypatch):
    path, refused = tmp_path / "a.jsonl", []

    def tried(operation):
        def wrapped(*args, **kwargs):
            for _ in ("before", "after"):
                with pytest.raises(InUseError):
                    AppendOnly(path)
                refused.append(operation.__name__)
                if _ == "before":
                    result = operation(*args, **kwargs)
            return result

        return wrapped

    with AppendOnly(path) as file:
        file.append(b"one", b"two")
        with monkeypatch.context() as patched:
            patched.setattr(os, "replace", tried(os.replace))
            patched.setattr(os, "fsync", tried(os.fsync))
            file.replace([b"two"])
        with pytest.raises(InUseError):
            AppendOnly(path)
        file.append(b"three")
        assert list(file.lines()) == [b"two\n", b"three\n"]
    assert refused.count("replace") == 2
    assert path.read_bytes() == b"two\nthree\n"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    AppendOnly(path).close()


def test_a_failed_replacement_keeps_the_lines_and_the_lock(tmp_path, monkeypatch):
    path = tmp_path / "a.jsonl"
    with AppendOnly(path) as file:
        file.append(b"one")
        with monkeypatch.context() as patched:
            patched.setattr(os, "replace", Mock(side_effect=OSError(28, "No space left on device")))
            with pytest.raises(OSError, match="No space"):
                file.replace([b"two"])
        with pytest.raises(InUseError):
            AppendOnly(path)
        file.append(b"two")
    assert path.read_bytes() == b"one\ntwo\n"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_file_that_is_replaced_before_it_is_locked_is_opened_again(tmp_path, monkeypatch):
    path, lock_file = tmp_path / "a.jsonl", journal.lock_file
    path.write_bytes(b"old\n")

    def replaced_first(file, operation):
        monkeypatch.setattr(journal, "lock_file", lock_file)
        (tmp_path / "new").write_bytes(b"new\n")
        os.replace(tmp_path / "new", path)
        return lock_file(file, operation)

    monkeypatch.setattr(journal, "lock_file", replaced_first)
    with AppendOnly(path) as file:
        assert list(file.lines()) == [b"new\n"]
        file.append(b"more")
    assert path.read_bytes() == b"new\nmore\n"


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    path, write = tmp_path / "a.jsonl", os.write
    with AppendOnly(path) as file:
        file.append(b"one")

        def half(number, data):
            if len(data) < 4:
                raise OSError(28, "No space left on device")
            return write(number, data[: len(data) // 2])

        monkeypatch.setattr(os, "write", half)
        with pytest.raises(OSError, match="No space"):
            file.append(b"a longer line")
        monkeypatch.undo()
        assert path.read_bytes() == b"one\n"
        file.append(b"two")
    assert path.read_bytes() == b"one\ntwo\n"


def test_plain_records(tmp_path):
    path = tmp_path / "a.jsonl"
    assert plain_records(path) == []
    append_records(path, {"a": 1}, {"a": 2})
    with open(path, "ab") as file:
        file.write(b'{"a": 3')
    assert plain_records(path) == [{"a": 1}, {"a": 2}]
    append_records(path, {"a": 4})
    assert plain_records(path) == [{"a": 1}, {"a": 2}, {"a": 4}]
