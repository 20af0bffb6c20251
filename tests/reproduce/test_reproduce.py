"""`roborecover reproduce` from end to end, with a small policy on the fake simulator."""

from __future__ import annotations

import json

import pytest
import yaml

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.factories import fake_dataset, save_policy

pytestmark = pytest.mark.lerobot

COUNT, TRIALS = 4, 2


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """A configuration file as those of policies/eval are, of a small random policy."""
    folder = tmp_path_factory.mktemp("reproduce")
    dataset = fake_dataset(folder / "set", COUNT, horizon=12)
    policy = save_policy(folder / "policy")
    path = folder / "small.yaml"
    env = {"type": "roborecover_fake", "scenarios": str(dataset)}
    path.write_text(
        yaml.safe_dump({"env": env, "policy": {"path": str(policy), "device": "cpu", "n_action_steps": 2}})
    )
    return path


@pytest.fixture
def reproduce(config, tmp_path):
    def call(*extra, out="out"):
        status = main([
            "reproduce", str(config), "--out", str(tmp_path / out), "--trials", str(TRIALS),
            "--set", "runner.slots=1", *extra,
        ])  # fmt: skip
        path = tmp_path / out / "reproduction.json"
        return status, json.loads(path.read_text()) if path.exists() else None, tmp_path / out

    return call


@pytest.mark.nightly
@pytest.mark.slow
def test_a_score_that_is_reached_is_confirmed(reproduce, capfd):
    """A random policy solves nothing, which is what is published."""
    status, found, out = reproduce("--published", "0,0,1", "--margin", "99")
    assert status == 0
    assert (found["standing"], found["confirmed"]) == ("agrees", True)
    assert found["initial"]["measured"]["value"] == 0
    assert found["arms"]["recovery"]["trials"] == COUNT * TRIALS
    page = (out / "reproduction.md").read_text()
    assert "**Confirmed.**" in page
    assert "roborecover eval --config_path=" in page
    assert {row.start for row in read_trial_log(out / "recovery" / "trials.jsonl")} == {"recovery"}
    # Nothing is left to do: no run is started.
    capfd.readouterr()
    assert reproduce("--published", "0,0,1", "--margin", "99")[0] == 0
    assert "roborecover eval" not in capfd.readouterr().out


@pytest.mark.nightly
@pytest.mark.slow
def test_a_run_that_was_killed_goes_on(reproduce):
    _, found, out = reproduce("--published", "0,0,1", "--margin", "99")
    log = out / "recovery" / "trials.jsonl"
    whole = log.read_bytes()
    # As if it had been killed in the recovery arm.
    (out / "recovery" / "done.json").unlink()
    log.write_bytes(b"".join(whole.splitlines(keepends=True)[:3]))
    _, again, _ = reproduce("--published", "0,0,1", "--margin", "99")
    assert again["recovery"] == found["recovery"]
    assert log.read_bytes().startswith(b"".join(whole.splitlines(keepends=True)[:3]))
    assert len(read_trial_log(log)) == COUNT * TRIALS


@pytest.mark.nightly
@pytest.mark.slow
def test_a_score_that_is_missed_stops_before_the_recovery_arm(reproduce, capsys):
    status, found, out = reproduce("--published", "95,92,97")
    assert status == 1
    assert (found["standing"], found["confirmed"]) == ("lower", False)
    assert list(found["arms"]) == ["initial"]
    assert not (out / "recovery").exists()
    assert "**Not reproduced.**" in capsys.readouterr().out
    status, found, _ = reproduce("--published", "95,92,97", "--anyway")
    assert status == 1
    assert found["arms"]["recovery"]["trials"] == COUNT * TRIALS
    assert found["recovery"]["published"]["value"] is None
    assert "do not take it" in (out / "reproduction.md").read_text()


@pytest.mark.nightly
@pytest.mark.slow
def test_invalid_trials_alone_are_compared_with_nothing(reproduce, capsys):
    """A random policy solves nothing: as failures its invalid trials would agree with a published 0 %."""
    slow = ("--set", "env.step_s=2", "--set", "env.watchdog_s=0.05")
    status, found, out = reproduce("--published", "0,0,1", "--margin", "99", *slow)
    assert (status, found["standing"], list(found["arms"])) == (1, "unmeasured", ["initial"])
    assert (found["arms"]["initial"]["rate"]["value"], found["initial"]["measured"]["value"]) == (None, None)
    assert f"**Not measured.** Every trial from initial states was invalid ({COUNT * TRIALS} timeout)" in (
        capsys.readouterr().out
    )
    assert "so there is no rate" in (out / "reproduction.md").read_text()


@pytest.mark.nightly
@pytest.mark.slow
def test_a_run_that_fails_says_how_to_go_on(reproduce, capfd):
    assert reproduce("--set", "policy.path=/nowhere")[0] == 2
    err = capfd.readouterr().err
    assert "roborecover reproduce: the initial arm (`roborecover eval" in err
    assert "ended with status 2" in err
    assert "goes on" in err


def test_what_would_be_run(reproduce, config, capsys):
    assert reproduce("--print", "--inference-ms", "900000", "--batch", "1")[0] == 0
    out = capsys.readouterr().out.splitlines()
    # 4 scenarios, 2 trials, 12 steps, 2 actions an inference of a quarter of an hour.
    assert out[0].startswith(f"# initial: {COUNT * TRIALS} trials, at most 12 hours")
    assert "--env.start=recovery" in out[3]
    assert "--runner.slots=1" in out[3]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nobody"], "no checkpoint of policies/eval"),
        (["none.yaml"], "no such file"),
        (["pi05_libero", "--trials", "0"], "--trials=0"),
        (["pi05_libero", "--margin", "0"], "--margin=0"),
        (["pi05_libero", "--set", "env.start=initial"], "--env.start is set by this command"),
        (["pi05_libero", "--set", "cuda"], "NAME=VALUE"),
        (["pi05_libero", "--published", "x"], "RATE,LOW,HIGH"),
        (["pi05_libero", "--print", "--slots", "0"], "slots=0"),
    ],
)
def test_refusals(arguments, said, capsys):
    assert main(["reproduce", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_a_configuration_without_scenarios_is_refused(tmp_path, capsys):
    (tmp_path / "mine.yaml").write_text("policy: {path: x}\n")
    assert main(["reproduce", str(tmp_path / "mine.yaml"), "--print"]) == 2
    assert "no scenario set" in capsys.readouterr().err


def test_a_configuration_that_is_not_installed_is_said(monkeypatch, tmp_path, capsys):
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.reproduce import find_checkpoint

    with pytest.raises(OptionError, match="come with a clone"):
        find_checkpoint("pi05_libero", [tmp_path])
