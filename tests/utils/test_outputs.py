"""No command replaces results unasked, and none replaces a file that is in use."""

from __future__ import annotations

import json
import os
from types import SimpleNamespace

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.errors import InUseError
from lerobot_roborecover.evaluation.eval_info import check_eval_info
from lerobot_roborecover.logs.trial_log import TrialLog, read_trial_log
from lerobot_roborecover.utils import atomic_io
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.outputs import OutputExistsError, check_new_file, check_page, claim_page
from tests.support.trial_rows import policy_rows, three_policies, trial_row, write_log


def test_a_locked_file_is_never_replaced(tmp_path):
    log = TrialLog(tmp_path / "log.jsonl")
    log.append(trial_row(0))
    inode = log.path.stat().st_ino
    with pytest.raises(InUseError, match="in use by another process and is not replaced"):
        atomic_write(log.path, "other")
    with pytest.raises(InUseError):
        check_new_file(log.path, force=True)
    assert log.path.stat().st_ino == inode
    assert [p.name for p in tmp_path.iterdir()] == ["log.jsonl"]
    log.append(trial_row(1))
    log.close()
    atomic_write(log.path, "other")
    assert log.path.read_text() == "other"


def test_a_file_that_is_locked_while_its_successor_is_written_is_not_replaced(tmp_path):
    path, opened = tmp_path / "log.jsonl", []
    write_log(path, [trial_row(0)])

    def run_begins_meanwhile():
        with atomic_io.atomic_file(path) as temporary:
            temporary.write_text("other")
            opened.append(TrialLog(path))

    with pytest.raises(InUseError):
        run_begins_meanwhile()
    opened[0].append(trial_row(1))
    opened[0].close()
    assert [r.scenario_id for r in read_trial_log(path)] == ["s000", "s001"]


def test_merge_replaces_no_log_unasked_and_none_that_is_in_use(tmp_path, capsys):
    ours = write_log(tmp_path / "ours.jsonl", [trial_row(0)])
    theirs = write_log(tmp_path / "theirs.jsonl", [trial_row(0, policy="beta@2", success=False)])
    kept, merge = theirs.read_bytes(), ["merge", str(ours), "--out", str(theirs)]
    assert main(merge) == 2
    assert "theirs.jsonl exists and is not replaced" in capsys.readouterr().err
    with TrialLog(theirs)._file:
        assert main([*merge, "--force"]) == 2
        assert "in use by another process" in capsys.readouterr().err
    assert theirs.read_bytes() == kept
    for source in (ours, tmp_path / "link.jsonl"):
        if not source.exists():
            os.link(ours, source)
        assert main(["merge", str(ours), "--out", str(source), "--force"]) == 2
        assert "is also an input" in capsys.readouterr().err
    assert main([*merge, "--force"]) == 0
    assert theirs.read_bytes() != kept


def test_merge_replaces_no_log_whose_run_was_watched(tmp_path, capsys):
    from lerobot_roborecover.logs.sequential_record import record_path

    ours = write_log(tmp_path / "ours.jsonl", [trial_row(0)])
    record_path(tmp_path / "out.jsonl").write_text("{}")
    assert main(["merge", str(ours), "--out", str(tmp_path / "out.jsonl")]) == 2
    assert "how another run was watched" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["report.html", "report.md", "results.json", "figures"])
def test_a_report_replaces_earlier_reports_only(tmp_path, name, capsys):
    log, out = write_log(tmp_path / "a.jsonl", policy_rows("alpha@1", 4, 2, 0.5, 1)), tmp_path / "out"
    atomic_write(out / name / "mine" if name == "figures" else out / name, "mine")
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    command = ["report", str(log), "--out", str(out), "--draws", "100"]
    assert main(command) == 2
    assert f"{name} exists and was not made by this command" in capsys.readouterr().err
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


def test_a_page_is_made_again_and_other_files_stay(tmp_path):
    logs, out = tmp_path / "logs", tmp_path / "out"
    three_policies(logs, count=6, trials=2)
    atomic_write(out / "notes.txt", "mine")
    for _ in range(2):
        assert main(["leaderboard", str(logs), "--out", str(out), "--draws", "100"]) == 0
    assert (out / "notes.txt").read_text() == "mine"
    atomic_write(out / "index.html", "<p>mine</p>")
    assert main(["leaderboard", str(logs), "--out", str(out), "--draws", "100"]) == 2
    assert (out / "index.html").read_text() == "<p>mine</p>"


def test_a_page_that_a_crash_cut_short_is_made_again(tmp_path):
    names = ("page.html", "numbers.json")
    with pytest.raises(OSError, match="full"), claim_page(tmp_path / "out", names):
        raise OSError("the disk is full")
    assert list((tmp_path / "out").iterdir()) == []

    def writes_a_part():
        with claim_page(tmp_path / "out", names):
            atomic_write(tmp_path / "out" / "numbers.json", "{}")
            raise OSError("the disk is full")

    with pytest.raises(OSError, match="full"):
        writes_a_part()
    check_page(tmp_path / "out", names)
    (tmp_path / "out" / "page.html").unlink()
    with pytest.raises(OutputExistsError, match=r"numbers\.json exists"), claim_page(tmp_path / "out", names):
        pass
    with pytest.raises(OutputExistsError, match="is not a folder"):
        check_page(tmp_path / "out" / "numbers.json", names)


@pytest.mark.slow
def test_a_plan_replaces_earlier_plans_only(tmp_path, capsys):
    command = ["plan", "--rate", "50", "--trials", "1", "--out", str(tmp_path)]
    assert main(command) == 0
    assert main(command) == 0
    atomic_write(tmp_path / "plan.md", "my plan")
    assert main(command) == 2
    assert "plan.md exists and was not made by this command" in capsys.readouterr().err
    assert (tmp_path / "plan.md").read_text() == "my plan"


def test_a_run_replaces_no_other_runs_eval_info(tmp_path):
    path = tmp_path / "eval_info.json"
    log = SimpleNamespace(path=tmp_path / "trials.jsonl", rows=[SimpleNamespace(scenario_id="s001")])
    check_eval_info(path, log)
    path.write_text(json.dumps({"per_task": []}))
    check_eval_info(path, log)
    for text in (json.dumps({"per_task": [{"task_id": "s000"}]}), "mine"):
        path.write_text(text)
        with pytest.raises(OutputExistsError, match="the results of another run"):
            check_eval_info(path, log)
    path.write_text(json.dumps({"per_task": [{"task_id": "s001"}]}))
    check_eval_info(path, log)
