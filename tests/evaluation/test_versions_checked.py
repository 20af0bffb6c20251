"""Scores are refused where versions or assets differ from those that scores are defined on."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest

from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation import session, session_checks
from tests.support.factories import fake_scenario
from tests.support.loop import evaluate


@pytest.fixture
def recorded_elsewhere(tmp_path):
    scenario = fake_scenario(0)
    versions = {"numpy": "0.0.1", "fake": "1"}
    other = replace(scenario, fingerprint=replace(scenario.fingerprint, versions=versions))
    return write_scenarios(tmp_path / "set", [other])


def test_a_fingerprint_of_other_versions_is_refused_by_name(recorded_elsewhere, tmp_path):
    with pytest.raises(OptionError, match=r"recorded with numpy 0\.0\.1; here it is .*strict_versions=false"):
        evaluate(recorded_elsewhere, tmp_path / "log.jsonl", trials=1, batch=1)
    assert not (tmp_path / "log.jsonl").exists()


def test_unless_told_otherwise(recorded_elsewhere, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        rows = evaluate(recorded_elsewhere, tmp_path / "log.jsonl", trials=1, batch=1, strict_versions=False)
    assert len(rows) == 1
    assert "numpy 0.0.1" in caplog.text


def test_a_fingerprint_of_another_lerobot_is_not_refused(tmp_path):
    scenario = fake_scenario(0)
    other = replace(scenario, fingerprint=replace(scenario.fingerprint, versions={"lerobot": "0.0.1"}))
    root = write_scenarios(tmp_path / "set", [other])
    (row,) = evaluate(root, tmp_path / "log.jsonl", trials=1, batch=1)
    assert row.outcome in ("success", "horizon")


def test_a_wrong_simulator_version_is_refused(tmp_path, monkeypatch):
    root = write_scenarios(tmp_path / "set", [fake_scenario(0)])
    monkeypatch.setattr(
        session_checks, "version_problems", lambda platform: ["mujoco is 3.4.0; scores require 3.3.2"]
    )
    with pytest.raises(OptionError, match=r"mujoco is 3\.4\.0"):
        evaluate(root, tmp_path / "log.jsonl", trials=1, batch=1)


def test_other_assets_are_a_warning(tmp_path, caplog):
    """The handoff check decides whether they matter."""
    from lerobot_roborecover.evaluation.options import RecoveryOptions
    from lerobot_roborecover.workers.messages import SlotConfig

    scenario = fake_scenario(0)
    versions = {"fake": "1", "fake_assets": "aaaa"}
    root = write_scenarios(
        tmp_path / "set", [replace(scenario, fingerprint=replace(scenario.fingerprint, versions=versions))]
    )
    options = RecoveryOptions(scenarios=str(root), trial_log=str(tmp_path / "log.jsonl"))
    spec = session.SimulatorSpec(SlotConfig("fake"), {}, None, assets={"fake_assets": "bbbb"})
    with caplog.at_level(logging.WARNING):
        _, opened = session.create_session(options, spec, workers=False)
    opened.pool.close()
    assert "fake_assets aaaa; here it is bbbb" in caplog.text


@pytest.mark.parametrize(("split", "said"), [("", True), ("test", False)])
def test_a_run_says_which_splits_it_mixes(split, said, tmp_path, caplog):
    """A set that is named takes all its splits."""
    from lerobot_roborecover.evaluation.options import RecoveryOptions
    from lerobot_roborecover.workers.messages import SlotConfig

    both = [replace(fake_scenario(k), split=s) for k, s in enumerate(("train", "test"))]
    root = write_scenarios(tmp_path / "set", both)
    options = RecoveryOptions(scenarios=str(root), split=split, trial_log=str(tmp_path / "log.jsonl"))
    with caplog.at_level(logging.INFO):
        _, opened = session.create_session(
            options, session.SimulatorSpec(SlotConfig("fake"), {}, None), workers=False
        )
    opened.pool.close()
    assert ("(all splits: test 1, train 1; --env.split=test takes the tests alone)" in caplog.text) is said
