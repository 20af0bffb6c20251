"""Detectors side by side, from the command line to the page, on the fake simulator; and in use."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.datasets import load_scenarios, write_scenarios
from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.factories import fake_scenario, save_policy
from tests.support.played_trials import played_trial, played_trials
from tests.support.shipped_policies import CHECKPOINT
from tests.support.trial_rows import write_log

pytestmark = pytest.mark.lerobot
DETECTORS = (
    "constant", "elapsed,steps=60", "oracle", "no_progress,steps=5,scale=0.5", "chunks=chunk_disagreement",
    "knn=state_distance,k=1", "policy_features,steps=40",
)  # fmt: skip


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    scenarios = [
        replace(fake_scenario(i, horizon=90, steps=5), split="test" if i < 12 else "train") for i in range(18)
    ]
    return write_scenarios(tmp_path_factory.mktemp("set") / "set", scenarios, description="fake")


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Path:
    return save_policy(tmp_path_factory.mktemp("policy") / "act")


@pytest.fixture
def played(monkeypatch):
    """Trials that the scripted expert or noise has driven, in place of the policy's; how often each was asked
    for."""
    from lerobot_roborecover.detection import trials

    asked: list[str] = []

    def run_trials(policy, env, folder, **_):
        asked.append(folder.name)
        chosen = load_scenarios(env.scenarios, split=env.split, select=env.select)
        return played_trials(list(chosen), env.start)

    monkeypatch.setattr(trials, "run_trials", run_trials)
    return asked


def command(dataset, policy, out, *more, detectors=DETECTORS) -> list[str]:
    named = [part for d in detectors for part in ("--detector", d)]
    return [
        "detect", "evaluate", "--scenarios", str(dataset), "--policy", str(policy), *named,
        "--out", str(out), "--alpha", "0.4", "--frame-strips", "0", *more,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def measured(dataset, policy, tmp_path_factory):
    out = tmp_path_factory.mktemp("measured") / "out"
    with pytest.MonkeyPatch.context() as patch:
        from lerobot_roborecover.detection import trials

        patch.setattr(
            trials,
            "run_trials",
            lambda policy, env, folder, **_: played_trials(
                list(load_scenarios(env.scenarios, split=env.split)), env.start
            ),
        )
        assert main(command(dataset, policy, out, "--frame-strips", "2")) == 0
    return out


def test_numbers_page_and_strips(measured):
    numbers = json.loads((measured / "detectors.json").read_text())
    found = numbers["detectors"]
    assert list(found) == [
        "constant", "elapsed", "oracle", "no_progress", "chunks", "knn", "policy_features",
    ]  # fmt: skip
    oracle = found["oracle"]
    assert oracle["frames"]["needs help"]["auroc"]["value"] == 1.0
    assert oracle["conformal"]["detected_of_those_that_fail"]["value"] == 1.0
    assert oracle["conformal"]["detected_of_those_that_recover"]["value"] == 0.0
    assert oracle["conformal"]["clean_alarmed"]["value"] == 0.0
    assert oracle["conformal"]["median_delay_steps"] == 0.0
    assert found["constant"]["frames"]["needs help"]["auroc"]["low"] < 0.5
    # Trials that fail last longer: time alone ranks frames.
    assert found["elapsed"]["frames"]["needs help"]["auroc"]["value"] > 0.6
    # States of the expert's own rollouts against noise that drifts away.
    assert found["knn"]["frames"]["needs help"]["auroc"]["value"] > 0.8
    assert "steps of 6 successful clean rollouts" in found["knn"]["fitted_to"]
    assert found["policy_features"]["probabilities"]
    assert found["chunks"]["reads"].endswith("8 action chunks, 2 steps back")
    assert found["constant"]["own_decisions"]["clean_rollouts"] == 12
    assert found["elapsed"]["own_decisions"] is None
    assert all(d["cost_ms"] > 0 for d in found.values())
    page = (measured / "detectors.html").read_text()
    assert "When they fire" in page
    assert page.count("<figure>") == 4 + 2
    tables = {p.stem for p in (measured / "tables").glob("*.csv")}
    assert tables == {"detectors", "pairs", "alarms", "inputs"}
    pairs = {(p["a"], p["b"]): p for p in numbers["pairs"]}
    assert len(pairs) == 15, "all pairs of six; the oracle is in none"
    assert pairs["constant", "knn"]["verdict"] == "B is better"
    assert pairs["constant", "knn"]["family"] == 15
    scores = np.load(measured / "scores" / "knn.npz")
    assert scores["length"].sum() == len(scores["score"])
    # The oracle knows what is unknown in use.
    assert not (measured / "detectors" / "oracle").exists()
    saved = json.loads((measured / "detectors" / "knn" / "config.json").read_text())
    assert saved["threshold"] == pytest.approx(found["knn"]["conformal_threshold"], abs=1e-5)


@pytest.mark.nightly
def test_a_rerun_looks_at_nothing_twice(dataset, policy, tmp_path, played, monkeypatch):
    from lerobot_roborecover.detection import trials

    few = ("elapsed", "no_progress,steps=3")
    assert main(command(dataset, policy, tmp_path / "out", detectors=few)) == 0
    assert played == ["test-recovery", "test-initial"]  # nothing is to be fitted: no other split is run
    monkeypatch.setattr(trials, "replayed", lambda *_: pytest.fail("replayed again"))
    assert main(command(dataset, policy, tmp_path / "out", detectors=few)) == 0


def test_one_part_of_a_split_is_fitted_to_and_another_measured_on(dataset, policy, tmp_path, played):
    parts = ["--split", "test", "--fit-split", "test", "--select", "id=*-00*", "--fit-select", "id=*-01*"]
    assert main(command(dataset, policy, tmp_path / "out", *parts, detectors=("state_distance,k=1",))) == 0


@pytest.mark.parametrize(
    ("more", "detectors", "message"),
    [
        ((), ("constant", "constant,rate=0.5"), "two detectors have one name"),
        ((), ("no_progress,keys=observation.images.top",), "the environment gives no observation.images.top"),
        (("--fit-split", "test"), ("state_distance",), "--fit-split test is what is measured on"),
        (("--alpha", "1.5"), ("constant",), "--alpha=1.5: must be above 0 and below 1"),
        (("--training-data", "nowhere"), ("state_distance",), "nowhere: no LeRobotDataset there"),
    ],
)
def test_what_is_refused(dataset, policy, tmp_path, played, capsys, more, detectors, message):
    assert main(command(dataset, policy, tmp_path / "out", *more, detectors=detectors)) == 2
    assert message in capsys.readouterr().err
    assert not played  # before a trial was run


def test_one_of_the_two_ways_to_measure_is_asked_for(capsys):
    assert main(["eval-monitor", "--monitor", "m"]) == 2
    assert "--data is missing. Give --monitor and --data" in capsys.readouterr().err
    assert main(["eval-monitor", "--detector", "constant"]) == 2
    assert "--scenarios is missing" in capsys.readouterr().err
    assert main(["eval-monitor", "--detector", "constant", "--data", "d"]) == 2
    assert "--scenarios is missing" in capsys.readouterr().err
    asked = ["--detector", "constant", "--scenarios", "s", "--policy", CHECKPOINT]
    assert main(["eval-monitor", *asked, "--data", "d"]) == 2
    assert "--data does not belong to --detector" in capsys.readouterr().err


def test_a_comparison_needs_detectors_scenarios_and_a_policy(capsys):
    for argv, missing in (([], "detector"), (["--detector", "constant"], "scenarios")):
        assert main(["detect", "evaluate", *argv]) == 2
        assert f"--{missing} is missing. Give --detector, --scenarios" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["detect", "evaluate-frames", "--monitor", "m"])
    assert "required: --data" in capsys.readouterr().err


@pytest.fixture(scope="module")
def forks(dataset, policy, tmp_path_factory) -> Path:
    """A log of forks of the training scenarios: at every step the policy would fail, an expert would not; in
    clean rollouts nothing is gained."""
    from lerobot_roborecover.detection.forks.arms import ForkArm
    from lerobot_roborecover.detection.forks.trial import Fork
    from lerobot_roborecover.logs.row import ACTIONS_FOLDER, actions_path
    from lerobot_roborecover.policies.identity import policy_identity

    folder = tmp_path_factory.mktemp("forks")
    (folder / ACTIONS_FOLDER).mkdir()
    rows = []
    for scenario in load_scenarios(dataset, split="train"):
        for start in ("recovery", "initial"):
            alone = played_trial(scenario, start, expert=start == "initial")
            helped = played_trial(scenario, start, expert=True)
            for step in (0, 4, 8):
                for arm, trial in (("continue", alone), ("correction", helped)):
                    note = Fork(scenario, alone, step, ForkArm(arm, "" if arm == "continue" else "c")).note()
                    row = replace(
                        trial.row, policy=policy_identity(str(policy)), config_hash=f"{arm} {start} {step}",
                        options={"fork": note.as_json()},
                    )  # fmt: skip
                    rows.append(row)
                    np.save(actions_path(folder / ACTIONS_FOLDER, row), trial.actions)
    write_log(folder / "trials.jsonl", rows)
    return folder


@pytest.mark.nightly
def test_an_expected_gain_is_learned_from_forks(dataset, policy, forks, tmp_path, played, capsys):
    """Of what was seen at the forks alone; what is saved never steps in where harm is expected."""
    gain = ("gain=recovery_gain,steps=300", "elapsed")
    out = tmp_path / "out"
    assert main(command(dataset, policy, out, "--forks", str(forks), detectors=gain)) == 0
    assert played == ["test-recovery", "test-initial"]  # no trials of the training split are asked for
    found = json.loads((out / "detectors.json").read_text())["detectors"]["gain"]
    assert found["fitted_to"] == "36 forks of 12 trials: 18 rescued, 0 harmed, 18 alike"
    assert not found["probabilities"]
    assert found["own_decisions"] is not None
    saved = json.loads((out / "detectors" / "gain" / "config.json").read_text())
    assert saved["threshold"] == pytest.approx(max(0, found["conformal_threshold"]), abs=1e-5)
    assert (saved["arm"], saved["policy"]) == ("correction:c", "act")
    used = json.loads((out / "detectors" / "gain" / "monitor_training.json").read_text())["scenarios"]
    assert set(used) == {s.id for s in load_scenarios(dataset, split="train")}
    # Saved, it is held out against other scenarios, as a monitor is.
    on_train = command(dataset, policy, tmp_path / "again", detectors=(f"g={out / 'detectors' / 'gain'}",))
    assert main([*on_train, "--split", "train"]) == 2
    assert "6 scenarios are in training and in validation" in capsys.readouterr().err


def test_forks_that_teach_nothing_are_refused(dataset, policy, forks, tmp_path, played, capsys):
    def refused(message, *more, detectors=("recovery_gain",), of=policy):
        assert main(command(dataset, of, tmp_path / "out", *more, detectors=detectors)) == 2
        assert message in capsys.readouterr().err
        assert not played

    with_log = ("--forks", str(forks))
    refused("recovery_gain learns from forks: give --forks LOG")
    refused("no detector learns from forks", *with_log, detectors=("elapsed",))
    refused("no log there; `roborecover detect fork --out", "--forks", str(tmp_path))
    refused("no arm begins with 'rollback'", *with_log, detectors=("recovery_gain,arm=rollback",))
    refused("in training and in validation", *with_log, "--split", "train")
    refused("Fork its own trials", *with_log, of=save_policy(tmp_path / "other", "diffusion"))
    rows = read_trial_log(forks / "trials.jsonl")
    plain = write_log(tmp_path / "plain.jsonl", [replace(row, options={}) for row in rows])
    refused("the log has no forks", "--forks", str(plain))


@pytest.mark.nightly
@pytest.mark.slow
def test_what_is_said_in_use_is_what_was_measured(measured, dataset, policy, tmp_path):
    """A saved detector in the composite policy triggers where its measured score first passes the threshold,
    with that score: the base acts as it acted in the trials, up to then."""
    saved = [f"{name}={measured / 'detectors' / name}" for name in ("knn", "chunks")]
    few = ["--select", "id=fake-push-left-00*"]
    assert main(command(dataset, policy, tmp_path / "out", *few, detectors=saved)) == 0
    for name in ("knn", "chunks"):
        scores = np.load(tmp_path / "out" / "scores" / f"{name}.npz")
        starts = np.cumsum(scores["length"]) - scores["length"]
        after = {
            str(scores["scenario"][i]): scores["score"][starts[i] : starts[i] + scores["length"][i]][
                scores["handoff"][i] :
            ]
            for i in np.flatnonzero(scores["start"] == "recovery")
        }
        threshold = float(np.median(np.concatenate(list(after.values()))))
        log = tmp_path / name / "trials.jsonl"
        run = [
            "eval", "--env", "roborecover_fake", f"--env.scenarios={dataset}", "--env.split=test",
            f"--env.select={few[1]}", "--policy.type=roborecover_intervention",
            "--policy.mode=monitor_reversion", f"--policy.base.path={policy}", "--eval.n_episodes=1",
            "--policy.device=cpu", f"--policy.monitor.path={measured / 'detectors' / name}",
            f"--policy.monitor.threshold={threshold}", f"--env.trial_log={log}",
            f"--output_dir={tmp_path / name}",
        ]  # fmt: skip
        assert main(run) == 0
        rows = read_trial_log(log)
        assert len(rows) == len(after) > 1
        for row in rows:
            told = next(i for i in row.interventions if i["kind"] == "monitor")
            above = np.flatnonzero(after[row.scenario_id] > threshold)
            assert told["step"] == (int(above[0]) if len(above) else None)
            if len(above):
                assert told["score"] == pytest.approx(after[row.scenario_id][above[0]], rel=1e-3)
        assert any(i.get("step") for row in rows for i in row.interventions)


def test_the_composite_policy_refuses_what_would_never_trigger(dataset, policy, tmp_path, capsys):
    run = [
        "eval", "--env", "roborecover_fake", f"--env.scenarios={dataset}",
        "--policy.type=roborecover_intervention", "--policy.mode=monitor_reversion",
        f"--policy.base.path={policy}", "--policy.device=cpu", f"--output_dir={tmp_path}",
    ]  # fmt: skip
    for monitor, message in (
        ("elapsed", "has no threshold, and would never trigger"),
        ("state_distance", "has not been fitted"),
        ("oracle", "which is unknown while a trial runs"),
    ):
        assert main([*run, f"--policy.monitor.path={monitor}"]) == 2
        assert message in capsys.readouterr().err
