"""Shards come together to the whole, or are refused with the difference named."""

from __future__ import annotations

import json

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.logs.merge import merge
from lerobot_roborecover.logs.trial_log import TrialLogError, read_trial_log
from tests.support.factories import fake_dataset
from tests.support.loop import evaluate, outcomes


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shards")
    dataset = fake_dataset(folder / "set", 4)
    for k in range(2):
        evaluate(dataset, folder / f"{k}.jsonl", trials=2, batch=1, shard=f"{k}/2")
    evaluate(dataset, folder / "whole.jsonl", trials=2, batch=2)
    return folder


def test_shards_make_the_whole(shards, tmp_path, capsys):
    out = tmp_path / "merged.jsonl"
    assert main(["merge", str(shards / "0.jsonl"), str(shards / "1.jsonl"), "--out", str(out)]) == 0
    assert "8 trials of 4 scenarios" in capsys.readouterr().out
    rows = read_trial_log(out)
    assert outcomes(rows) == outcomes(read_trial_log(shards / "whole.jsonl"))
    assert {(r.run_scenarios, r.run_trials, r.shard) for r in rows} == {(4, 2, "0/2"), (4, 2, "1/2")}


def test_a_shard_alone_says_what_is_missing(shards, tmp_path, capsys):
    assert main(["merge", str(shards / "0.jsonl"), "--out", str(tmp_path / "m.jsonl")]) == 0
    assert "incomplete: 2 of 4 scenarios; shard 1/2 is missing" in capsys.readouterr().err


def test_overlapping_logs_keep_each_trial_once(shards, tmp_path):
    rows = merge(
        [shards / "0.jsonl", shards / "whole.jsonl", shards / "whole.jsonl"], tmp_path / "m.jsonl"
    ).rows
    assert len(rows) == 8


def edited(shards, tmp_path, **changes):
    path = tmp_path / "edited.jsonl"
    records = [json.loads(line) | changes for line in (shards / "1.jsonl").read_text().splitlines()]
    path.write_text("".join(json.dumps(r) + "\n" for r in records))
    return path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"versions": {"mujoco": "3.4.0"}}, r"version of mujoco is None .* '3\.4\.0'"),
        ({"execution_horizon": 5}, "execution horizon is None .* 5"),
        ({"options": {"handoff_check": False}}, "option handoff_check is True .* False"),
        ({"run_seed": 7}, "run seed is 1000 .* 7"),
        ({"dataset_revision": "abc"}, "dataset revision"),
    ],
)
def test_other_protocols_are_refused_by_name(shards, tmp_path, changes, words):
    other = edited(shards, tmp_path, **changes)
    with pytest.raises(TrialLogError, match=words):
        merge([shards / "0.jsonl", other], tmp_path / "m.jsonl")
    assert not (tmp_path / "m.jsonl").exists()


def test_two_scenarios_of_one_name_are_refused(shards, tmp_path):
    other = edited(shards, tmp_path, scenario_sha256="0" * 64)
    with pytest.raises(TrialLogError, match="two different scenarios are called"):
        merge([shards / "whole.jsonl", other], tmp_path / "m.jsonl")


def test_disagreeing_outcomes_are_refused(shards, tmp_path):
    other = edited(shards, tmp_path, outcome="sim_error", success=False)
    with pytest.raises(TrialLogError, match="ended as 'sim_error'"):
        merge([shards / "1.jsonl", other], tmp_path / "m.jsonl")


def test_a_missing_part_is_said(shards, tmp_path):
    cut = tmp_path / "cut.jsonl"
    cut.write_text("".join(line + "\n" for line in (shards / "1.jsonl").read_text().splitlines()[:-1]))
    with pytest.raises(TrialLogError, match=r"1 with 1 trials, 3 with 2 trials"):
        merge([shards / "0.jsonl", cut], tmp_path / "m.jsonl")
    assert len(merge([shards / "0.jsonl", cut], tmp_path / "m.jsonl", unequal=True).rows) == 7
