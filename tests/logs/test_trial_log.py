"""The trial log keeps every complete line and refuses what it cannot trust."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, replace

import numpy as np
import pytest

from lerobot_roborecover.logs.row import EvalProtocol, make_row, trial_seed
from lerobot_roborecover.logs.trial_log import TrialLog, TrialLogError, read_trial_log
from lerobot_roborecover.scenario import Outcome
from tests.support.factories import fake_dataset, fake_scenario
from tests.support.loop import evaluate
from tests.support.trial_rows import trial_row

PROTOCOL = EvalProtocol("recovery", 0, "push@1", 1000, 10)


def row(trial: int, outcome: Outcome = Outcome.SUCCESS, protocol: EvalProtocol = PROTOCOL):
    steps = fake_scenario(0).task.horizon if outcome is Outcome.HORIZON else 7
    return make_row(
        fake_scenario(0), protocol, dataset="d", dataset_revision=None, trial=trial,
        noise="per_trial", batch_size=1,
        outcome=outcome, reason="", steps=steps, handoff=None, sim_s=0.1, policy_s=0.2, actions_sha256="",
    )  # fmt: skip


def written(path, *rows):
    log = TrialLog(path)
    for r in rows:
        log.append(r)
    log.close()
    return path


def test_rows_come_back_as_written(tmp_path):
    path = written(tmp_path / "deep" / "log.jsonl", row(0), row(1, Outcome.HORIZON))
    assert read_trial_log(path) == [
        row(0).__class__(**json.loads(line)) for line in path.read_text().splitlines()
    ]
    assert [r.trial for r in read_trial_log(path)] == [0, 1]


@pytest.mark.parametrize("cut", [1, 5, 200])
def test_a_cut_last_line_is_dropped_and_its_trial_can_be_written_again(tmp_path, cut):
    path = written(tmp_path / "log.jsonl", row(0), row(1))
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    assert [r.trial for r in read_trial_log(path)] == [0]
    log = TrialLog(path)
    assert log.dropped_bytes > 0
    log.append(row(1))
    log.close()
    assert [r.trial for r in read_trial_log(path)] == [0, 1]


def test_a_damaged_line_in_the_middle_is_refused_by_line(tmp_path):
    path = written(tmp_path / "log.jsonl", row(0), row(1))
    lines = path.read_text().splitlines()
    path.write_text(lines[0][:40] + "\n" + lines[1] + "\n")
    with pytest.raises(TrialLogError, match="line 1: not a JSON trial row"):
        TrialLog(path)


def test_two_outcomes_for_one_trial_are_an_error(tmp_path):
    path = written(tmp_path / "log.jsonl", row(0))
    other = written(tmp_path / "other.jsonl", row(0, Outcome.HORIZON))
    path.write_text(path.read_text() + other.read_text())
    with pytest.raises(TrialLogError, match=r"line 2: field 'outcome': trial 0 .* 'horizon' .* 'success'"):
        read_trial_log(path)


def test_a_log_in_use_is_refused(tmp_path):
    log = TrialLog(tmp_path / "log.jsonl")
    with pytest.raises(TrialLogError, match="in use by another process"):
        TrialLog(tmp_path / "log.jsonl")
    log.close()
    TrialLog(tmp_path / "log.jsonl").close()


def test_a_log_is_never_without_its_lock_while_rows_are_set_aside(tmp_path, monkeypatch):
    log, replace, tried = TrialLog(tmp_path / "log.jsonl"), os.replace, []

    def another_process_tries(*args):
        for _ in range(2):
            with pytest.raises(TrialLogError, match="in use by another process"):
                TrialLog(log.path)
            tried.append(args)
            if len(tried) == 1:
                replace(*args)

    for trial, outcome in enumerate((Outcome.SUCCESS, Outcome.TIMEOUT)):
        log.append(row(trial, outcome))
    monkeypatch.setattr(os, "replace", another_process_tries)
    assert log.set_aside(["timeout"], tmp_path / "retried.jsonl") == 1
    assert len(tried) == 2
    log.append(row(1))
    log.close()
    assert [r.outcome for r in read_trial_log(log.path)] == ["success", "success"]


def test_a_future_schema_and_unknown_fields_are_refused(tmp_path):
    path = written(tmp_path / "log.jsonl", row(0))
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"schema": 99}) + "\n")
    with pytest.raises(TrialLogError, match="schema 99"):
        read_trial_log(path)
    path.write_text(json.dumps(record | {"colour": "red"}) + "\n")
    with pytest.raises(TrialLogError, match="'colour'"):
        read_trial_log(path)


def test_a_file_that_is_no_log_is_refused(tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_bytes(b"\x80\x02\xff\xfe binary\n")
    with pytest.raises(TrialLogError, match="not UTF-8"):
        TrialLog(path)


def test_what_decides_a_result_decides_the_key():
    keys = {
        row(0).key(),
        row(1).key(),
        row(0, protocol=EvalProtocol("initial", 0, "push@1", 1000, 10)).key(),
        row(0, protocol=EvalProtocol("recovery", 0, "push@2", 1000, 10)).key(),
        row(0, protocol=EvalProtocol("recovery", 0, "push@1", 1001, 10)).key(),
        row(0, protocol=EvalProtocol("recovery", 0, "push@1", 1000, 5)).key(),
        row(0, protocol=EvalProtocol("recovery", 0, "push@1", 1000, 10, {"size": 64})).key(),
        row(0, protocol=EvalProtocol("recovery", 0, "push@1", 1000, 10, {}, {"mujoco": "3.3.2"})).key(),
    }
    assert len(keys) == 8


def test_trial_seeds_differ_in_all_three_arguments():
    seeds = {trial_seed(s, i, k) for s in (0, 1) for i in ("a", "b") for k in (0, 1)}
    assert len(seeds) == 8
    assert all(0 <= s < 2**63 for s in seeds)
    assert trial_seed(None, "a", 0) is None


def test_logs_of_before_progress_are_read_and_joined(tmp_path):
    """Schema 1 had no progress; what is read is written again as of today."""
    new, old = asdict(trial_row(0, progress=[0, 40, 100])), asdict(trial_row(1))
    old["schema"] = 1
    del old["progress"]
    log = tmp_path / "trials.jsonl"
    log.write_text("".join(json.dumps(r) + "\n" for r in (new, old)), encoding="utf-8")
    first, second = read_trial_log(log)
    assert (first.progress, second.progress) == ([0, 40, 100], None)
    again = tmp_path / "again.jsonl"
    again.write_text("".join(json.dumps(asdict(r)) + "\n" for r in (first, second)), encoding="utf-8")
    assert read_trial_log(again) == [first, second]
    for wrong in ([], [101], [0.5], [True], "50", [-1], {}):
        log.write_text(json.dumps(new | {"progress": wrong}) + "\n", encoding="utf-8")
        with pytest.raises(TrialLogError, match="field 'progress'"):
            read_trial_log(log)


def test_logs_of_before_first_states_are_read(tmp_path):
    """Schema 2 said neither the first state nor the policy's settings nor the extent of its run."""
    new = asdict(trial_row(0, first_state="a" * 64, run_scenarios=10, run_trials=5, shard="1/3"))
    old = asdict(trial_row(1))
    old["schema"] = 2
    for name in ("first_state", "policy_settings", "run_scenarios", "run_trials", "shard"):
        del old[name]
    log = tmp_path / "trials.jsonl"
    log.write_text("".join(json.dumps(r) + "\n" for r in (new, old)), encoding="utf-8")
    first, second = read_trial_log(log)
    assert asdict(first) == new
    assert (second.first_state, second.policy_settings, second.run_scenarios, second.shard) == (
        "",
        None,
        None,
        "",
    )
    wrong = {
        "first_state": "ab",
        "policy_settings": [],
        "run_scenarios": 0,
        "run_trials": "5",
        "shard": "3/3",
    }
    for name, value in wrong.items():
        log.write_text(json.dumps(new | {name: value}) + "\n", encoding="utf-8")
        with pytest.raises(TrialLogError, match=f"field '{name}'"):
            read_trial_log(log)


def test_scenarios_of_one_first_state_share_its_hash():
    """The recovery point does not count; the reset, the task and the settling actions do."""
    first, *others = (fake_scenario(seed) for seed in range(3))
    longer = replace(
        first, id="longer", prefix=np.vstack([first.prefix, first.prefix[-1:]]), fingerprint=None
    )
    assert longer.sha256() != first.sha256()
    assert longer.first_state_sha256() == first.first_state_sha256()
    elsewhere = replace(first, reset=replace(first.reset, seed=987_654))
    renamed = replace(first, task=replace(first.task, instruction="another"))
    assert len({s.first_state_sha256() for s in (first, elsewhere, renamed, *others)}) == 5


def test_every_step_has_its_progress(tmp_path):
    """One number at the handoff and one after each step; 100 exactly on success."""
    root = fake_dataset(tmp_path / "set", 4, horizon=60)
    rows = evaluate(root, tmp_path / "log.jsonl", trials=1, batch=1)
    assert {r.success for r in rows} == {True, False}
    for row in rows:
        assert len(row.progress) == row.steps + 1
        assert (row.progress[-1] == 100) == row.success
        assert max(row.progress[:-1]) < 100
    assert any(0 < share < 100 for row in rows for share in row.progress)
