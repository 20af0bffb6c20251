"""What every command says of a full disk, an unwritable folder, a closed pipe and a stop signal: one line."""

from __future__ import annotations

import dataclasses
import errno
import io
import os
import resource
import signal
import subprocess
import sys
import types
from pathlib import Path

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.errors import naming, os_error_line
from lerobot_roborecover.utils.atomic_io import atomic_dir, atomic_write
from lerobot_roborecover.utils.journal import AppendOnly
from tests.support.trial_rows import policy_rows, write_log

CONVERSION = Path(__file__).parents[2] / "conversion"
START = [sys.executable, "-m", "lerobot_roborecover.cli.main"]


@pytest.fixture
def stands_in(monkeypatch):
    """Puts a function in the place of what `roborecover doctor` does."""

    def put(run):
        options = dataclasses.make_dataclass("Options", [], module=__name__)
        module = types.SimpleNamespace(HELP="", OPTIONS=options, run=lambda options: run())
        monkeypatch.setitem(sys.modules, "lerobot_roborecover.cli.doctor", module)

    return put


@pytest.fixture
def small_files():
    """No file may grow beyond 20 kB: writing fails as on a full disk, for root as well."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def one_line(capsys) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device. Make room"),
        (PermissionError(errno.EACCES, "denied", "/there"), "/there: Permission denied. Check its perm"),
        (OSError(errno.EROFS, "", "/there"), "/there: Read-only file system. That file system"),
        (FileNotFoundError(errno.ENOENT, "none", "/there"), "/there: No such file or directory. Check"),
        (OSError("a library's\n  own words"), "roborecover doctor: a library's own words"),
    ],
)
def test_an_error_of_the_system_is_one_line(stands_in, capsys, error, words):
    def fails():
        raise error

    stands_in(fails)
    assert main(["doctor"]) == 2
    line = one_line(capsys)
    assert line.startswith("roborecover doctor: ")
    assert words in line
    assert ("Finished trials are kept" in line) == (error.errno in (errno.ENOSPC, errno.EACCES, errno.EROFS))


def test_an_error_of_ours_is_no_error_of_the_system(stands_in):
    def fails():
        raise ZeroDivisionError

    stands_in(fails)
    with pytest.raises(ZeroDivisionError):
        main(["doctor"])


def write_file(path):
    atomic_write(path, b"x" * 30_000)


def write_folder(path):
    with atomic_dir(path) as folder:
        folder.mkdir()
        (folder / "big").write_bytes(b"x" * 30_000)


def write_arrow(path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    with atomic_dir(path) as folder:
        folder.mkdir()
        pq.write_table(pa.table({"x": [os.urandom(100) for _ in range(900)]}), folder / "x.parquet")


def append_line(path):
    with AppendOnly(path) as file:
        file.append(b"first")
        file.append(b"x" * 30_000)


@pytest.mark.parametrize("write", [write_file, write_folder, write_arrow, append_line])
def test_a_full_disk_names_the_file_and_leaves_what_was_there(tmp_path, write, small_files):
    path = tmp_path / "there"
    with pytest.raises(OSError) as raised:
        write(path)
    assert os_error_line(raised.value).startswith(f"{path}: File too large. Raise the limit")
    assert [p.read_bytes() for p in tmp_path.iterdir()] == ([b"first\n"] if write is append_line else [])


def test_an_error_of_another_thing_is_not_said_to_be_of_the_file(tmp_path):
    with pytest.raises(OSError) as raised, naming(tmp_path):
        raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")
    assert raised.value.filename is None


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two policies' logs of 60 trials; one name is in no 8-bit encoding."""
    folder = tmp_path_factory.mktemp("logs")
    return [
        str(write_log(folder / f"{number}.jsonl", policy_rows(name, 12, 5, 0.5, number)))
        for number, name in enumerate(("first@1", "zweite ü≥政策@2"))
    ]


@pytest.mark.parametrize("command", [["report", "--draws", "200"], ["merge"]])
def test_a_command_whose_result_does_not_fit_says_so_in_one_line(
    command, logs, tmp_path, capsys, small_files
):
    out = tmp_path / "out"
    assert main([*command, *logs, "--out", str(out)]) == 2
    line = one_line(capsys)
    assert line.startswith(f"roborecover {command[0]}: {tmp_path}")
    assert "File too large" in line
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == [], "neither cut nor temporary files"


def test_a_folder_in_the_place_of_a_file_is_one_line(logs, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["merge", *logs, "--out", str(tmp_path / "file" / "merged.jsonl")]) == 2
    assert f"{tmp_path}/file" in one_line(capsys)


@pytest.mark.slow
def test_text_is_printed_in_an_encoding_that_lacks_it(logs, tmp_path, monkeypatch):
    streams = [io.TextIOWrapper(io.BytesIO(), encoding="ascii") for _ in range(2)]
    monkeypatch.setattr("sys.stdout", streams[0])
    monkeypatch.setattr("sys.stderr", streams[1])
    assert main(["report", *logs, "--draws", "200", "--out", str(tmp_path / "out")]) == 0
    assert "\\u653f\\u7b56" in streams[0].buffer.getvalue().decode("ascii")


def started(*words: str, out: int, err: int = subprocess.PIPE, **environment: str) -> subprocess.Popen:
    return subprocess.Popen([*START, *words], stdout=out, stderr=err, env={**os.environ, **environment})


@pytest.mark.parametrize("words", [["--help"], ["doctor", "--help"], ["merge"]])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_closed_pipe_ends_quietly(words, unbuffered, logs, tmp_path):
    words = [*words, *logs, "--out", str(tmp_path / "merged.jsonl")] if words == ["merge"] else words
    read, write = os.pipe()
    os.close(read)
    process = started(*words, out=write, PYTHONUNBUFFERED=unbuffered)
    os.close(write)
    _, said = process.communicate()
    assert said == b""
    assert process.returncode in ((141,) if words[0] == "merge" else (0, 141))


def test_standard_error_may_be_the_closed_pipe(logs):
    read, write = os.pipe()
    os.close(read)
    process = started("merge", "/not/there", "--out", "/not/either", out=subprocess.PIPE, err=write)
    os.close(write)
    assert process.communicate()[0] == b""
    assert process.returncode in (2, 141)


def test_standard_output_on_a_full_disk_is_one_line(logs, tmp_path):
    with open("/dev/full", "wb") as full:
        process = started(
            "merge", *logs, "--out", str(tmp_path / "merged.jsonl"), out=full.fileno(), PYTHONUNBUFFERED=""
        )
        _, said = process.communicate()
    assert said.decode().splitlines() == [
        "roborecover merge: standard output: No space left on device. Make room on that disk, then run the "
        "command again. Finished trials are kept"
    ]
    assert process.returncode == 2


def test_a_pipe_between_processes_is_not_the_reader_of_the_output(stands_in, capsys):
    def fails():
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    stands_in(fails)
    assert main(["doctor"]) == 2
    assert one_line(capsys) == "roborecover doctor: Broken pipe"


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_stop_signals_let_a_command_put_things_in_order(stands_in, capsys, number, status):
    cleaned = []

    def works():
        try:
            signal.raise_signal(number)
        finally:
            cleaned.append(True)

    stands_in(works)
    # A shell's background job ignores SIGINT, and commands respect what is ignored.
    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    first = signal.signal(number, usual)
    try:
        assert main(["doctor"]) == status
        assert signal.getsignal(number) is usual
    finally:
        signal.signal(number, first)
    assert cleaned == [True]
    assert one_line(capsys) == "roborecover doctor: interrupted"


def test_under_nohup_a_closed_terminal_stops_nothing(stands_in):
    def works():
        signal.raise_signal(signal.SIGHUP)
        return 0

    stands_in(works)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert main(["doctor"]) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("script", sorted(CONVERSION.glob("*.py")), ids=lambda path: path.stem)
def test_conversion_scripts_are_guarded_as_commands_are(script):
    assert f'sys.exit(guarded("{script.stem}", main))' in script.read_text()
