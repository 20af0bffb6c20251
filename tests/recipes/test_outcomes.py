"""Stored trial logs are read as what they were, and written alike each time."""

from __future__ import annotations

import pytest

from lerobot_roborecover.env.trial_log import TrialLogError, read_trial_log
from recipes.outcomes import OUTCOMES, store_logs, stored_logs
from recipes.stepping_in import ARMS, stored_folder
from tests.support.trial_rows import policy_rows, write_log


def test_stored_logs_come_back(tmp_path):
    logs = {
        name: write_log(tmp_path / f"{name}.jsonl", policy_rows(name, 5, 2, 0.5, seed))
        for seed, name in enumerate(("direct", "gain"))
    }
    store_logs(logs, tmp_path / "stored")
    found = stored_logs(tmp_path / "stored")
    assert list(found) == ["direct", "gain"]
    assert all(read_trial_log(found[name]) == read_trial_log(log) for name, log in logs.items())
    before = {name: path.read_bytes() for name, path in found.items()}
    store_logs(logs, tmp_path / "stored")
    assert {name: path.read_bytes() for name, path in found.items()} == before


def test_what_is_not_there_or_damaged_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no stored outcomes"):
        stored_logs(tmp_path)
    (tmp_path / "bad.jsonl").write_text("{}\n")
    with pytest.raises(TrialLogError):
        store_logs({"bad": tmp_path / "bad.jsonl"}, tmp_path / "stored")
    assert not (tmp_path / "stored").exists()


def test_what_the_repository_keeps_is_whole():
    """Each arm has one trial of every test scenario, under the protocol of the others."""
    assert OUTCOMES.is_dir()
    logs = stored_logs(stored_folder("metaworld"))
    assert set(ARMS) < set(logs)
    rows = {name: read_trial_log(logs[name]) for name in ARMS}
    ids = {row.scenario_id for row in rows[ARMS[0]]}
    assert len(ids) == 359
    for of in rows.values():
        assert {row.scenario_id for row in of} == ids
        assert len(of) == len(ids)
