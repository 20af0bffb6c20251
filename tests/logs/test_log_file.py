"""Trial logs are read as what they are: compressed ones too, and what is none is refused with the remedy."""

from __future__ import annotations

import gzip
import json
import os
from dataclasses import asdict
from unicodedata import normalize

import pyarrow as pa
import pytest

from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.cli.main import main
from lerobot_roborecover.logs.log_file import LogFileError, open_log
from lerobot_roborecover.logs.row import EvalProtocol
from lerobot_roborecover.logs.trial_log import TrialLog, TrialLogError, read_log, read_trial_log
from tests.support.trial_rows import policy_rows, trial_row, write_log

ROWS = [trial_row(0), trial_row(1, success=False)]


def text(*rows) -> bytes:
    return b"".join(json.dumps(asdict(row)).encode() + b"\n" for row in rows)


def zstd(data: bytes) -> bytes:
    sink = pa.BufferOutputStream()
    with pa.CompressedOutputStream(sink, "zstd") as stream:
        stream.write(data)
    return sink.getvalue().to_pybytes()


@pytest.mark.parametrize("compress", [gzip.compress, zstd])
def test_compressed_logs_are_read_whatever_they_are_called(tmp_path, compress):
    path = tmp_path / "log.jsonl"
    path.write_bytes(compress(text(*ROWS)) + compress(text(trial_row(2))))
    found = read_log(path)
    assert found.rows == (*ROWS, trial_row(2))
    assert not found.cut
    path.write_bytes(compress(text(*ROWS)[:-5]))
    assert read_log(path).rows == (ROWS[0],)
    assert read_log(path).cut
    path.write_bytes(compress(text(*ROWS) * 50)[:-20])
    with pytest.raises(TrialLogError, match="damaged or cut short"):
        read_log(path)
    path.write_bytes(compress(b"x" * 2**25))
    with pytest.raises(TrialLogError, match="line 1: longer than"):
        read_log(path)
    path.write_bytes(compress(json.dumps([asdict(r) for r in ROWS]).encode()))
    with pytest.raises(TrialLogError, match="JSON array"):
        read_log(path)
    with pytest.raises(TrialLogError, match="it is compressed, which is read and not added to"):
        TrialLog(path)


def test_a_folder_of_compressed_logs_is_a_folder_of_logs(tmp_path):
    (tmp_path / "trials.jsonl.zst").write_bytes(zstd(text(*ROWS)))
    (tmp_path / "other.jsonl").write_bytes(text(trial_row(5)))
    assert len(read_study([str(tmp_path)]).arms[0].rows) == 2
    (tmp_path / "trials.jsonl.zst").rename(tmp_path / "a.jsonl.zst")
    assert len(read_study([str(tmp_path)]).arms[0].rows) == 3


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\xef\xbb\xbf" + text(*ROWS), r"byte-order mark. Remove it: tail -c \+4"),
        (text(*ROWS).decode().encode("utf-16"), "UTF-16 .* iconv -f UTF-16 -t UTF-8"),
        (text(*ROWS).decode().encode("utf-16-le"), "UTF-16 .* iconv"),
        (text(*ROWS).decode().encode("utf-16-be"), "UTF-16 .* iconv"),
        (json.dumps([asdict(r) for r in ROWS]).encode(), r"JSON array, .* jq -c '\.\[\]'"),
        (json.dumps([asdict(r) for r in ROWS], indent=1).encode(), "JSON array"),
        (text(*ROWS).replace(b"\n", b"\r"), "carriage returns alone"),
    ],
)
def test_a_file_that_only_resembles_a_log_is_refused_with_the_remedy(tmp_path, data, words):
    path = tmp_path / "log.jsonl"
    path.write_bytes(data)
    for open_it in (read_log, TrialLog):
        with pytest.raises(TrialLogError, match=words):
            open_it(path)
    assert path.read_bytes() == data


def test_windows_lines_and_empty_files_are_read(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_bytes(text(*ROWS).replace(b"\n", b"\r\n"))
    assert read_trial_log(path) == ROWS
    path.write_bytes(b"")
    assert read_log(path).rows == ()
    path.write_bytes(text(*ROWS)[:40])
    assert read_log(path).cut


def test_what_is_no_regular_file_is_refused_and_not_waited_for(tmp_path):
    path = tmp_path / "log.jsonl"
    os.mkfifo(path)
    for open_it in (read_log, TrialLog):
        with pytest.raises(TrialLogError, match="not a regular file"):
            open_it(path)
    with pytest.raises(LogFileError), open_log(path):
        pytest.fail("it was opened")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (text(trial_row(0, success=False, steps=3)), "line 1: field 'steps': steps is 3, .* 'horizon'"),
        (
            text(trial_row(0)).replace(b'"trial": 0', b'"trial": 0, "trial": 1'),
            "line 1: field 'trial' occurs twice",
        ),
        (
            text(trial_row(0)).replace(b'"obs_type"', b'"obs_type": "state", "obs_type"'),
            "line 1: field 'obs_type' occurs twice",
        ),
    ],
)  # fmt: skip
def test_rows_that_contradict_themselves_are_refused_by_line_and_field(tmp_path, line, words):
    path = tmp_path / "log.jsonl"
    path.write_bytes(line)
    with pytest.raises(TrialLogError, match=words):
        read_log(path)


def test_a_rollback_ends_by_horizon_after_all_steps_and_a_broken_trial_before(tmp_path):
    rollback = [{"kind": "rollback", "step": 40, "undone": 20, "solved_in_extra": True}]
    rows = [
        trial_row(0, success=False, interventions=rollback),
        trial_row(1, outcome="solved_by_prefix", steps=0),
        trial_row(2, outcome="sim_error", steps=310, interventions=rollback),
        trial_row(3, outcome="policy_error", steps=3),
    ]
    assert read_trial_log(write_log(tmp_path / "log.jsonl", rows)) == rows


def test_canonically_equal_names_are_one_policy(tmp_path):
    name = "modèle@1"
    for form in ("NFC", "NFD"):
        rows = policy_rows(normalize(form, name), 4, 1, 0.5, 1, config_hash="one")
        log = write_log(
            tmp_path / f"{form}.jsonl", [r for r in rows if (r.scenario_id < "s002") == (form == "NFC")]
        )
        assert read_log(log).policies == (normalize("NFC", name),)
    study = read_study([str(tmp_path / "NFC.jsonl"), str(tmp_path / "NFD.jsonl")])
    assert study.policies == (normalize("NFC", name),)
    hashes = {EvalProtocol("recovery", 0, normalize(f, name), 1000, 10).config_hash() for f in ("NFC", "NFD")}
    assert len(hashes) == 1
    named = read_study([f"{normalize('NFD', 'é')}={tmp_path / 'NFC.jsonl'}"])
    assert named.policies == (normalize("NFC", "é"),)


@pytest.mark.parametrize("other", ["\u0430ct", "\uff41ct", "a\u0441t", "act ", "\u03b1ct"])
def test_policies_whose_names_look_alike_are_refused(tmp_path, other):
    logs = [
        write_log(tmp_path / f"{n}.jsonl", [trial_row(0, policy=p)]) for n, p in enumerate(("act", other))
    ]
    with pytest.raises(RowsError, match=r"look alike, .* character \d is .*U\+.*NAME=LOG"):
        read_study(list(map(str, logs)))
    assert len(read_study([str(logs[0]), f"second={logs[1]}"]).policies) == 2


def test_names_that_differ_visibly_are_accepted(tmp_path):
    names = ("act", "Act", "café", "cafe", "кот", "模型一", "模型二", "हिन्दी", "हिन्दि")
    logs = [write_log(tmp_path / f"{n}.jsonl", [trial_row(0, policy=p)]) for n, p in enumerate(names)]
    assert len(read_study(list(map(str, logs))).policies) == len(names)


@pytest.mark.parametrize(
    "command",
    [
        ["report", "{log}", "--out", "{out}", "--seed", "-1"],
        ["compare", "{log}", "{log}", "--seed=-1"],
        ["curate", "split", "{out}", "--train", "0.5", "--test", "0.5", "--seed", "-1"],
        ["check", "platform", "fake", "--seed", "-1"],
    ],
)
def test_a_negative_seed_is_refused_in_one_line(tmp_path, command, capsys):
    log = write_log(tmp_path / "a.jsonl", policy_rows("a@1", 4, 1, 0.5, 1))
    assert main([part.format(log=log, out=tmp_path / "out") for part in command]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert "--seed=-1: must be from 0 to" in said[0]
