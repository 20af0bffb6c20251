"""From trial logs to the dataset that trains Correction: who is chosen, who is dropped and why."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.curation.donors import (
    DonorOptions,
    add_step,
    choose_candidates,
    deduplicate,
    judge,
    write_donors,
)
from lerobot_roborecover.curation.funnel import StageCounts
from lerobot_roborecover.curation.policy_trials import read_trials
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.logs.row import ACTIONS_FOLDER, LoggedTrial, actions_digest, actions_path
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_scenario, save_policy
from tests.support.loop import push_policy
from tests.support.trial_rows import trial_row, write_log

BASE, GOOD, FAIR = "base@1", "good@2", "fair@3"


def scenarios(count: int = 6) -> list:
    """Of split train; each pair of them is of one source record."""
    made = [fake_scenario(i, horizon=200) for i in range(count)]
    return [replace(s, split="train", cluster=f"rollout-{i // 2}") for i, s in enumerate(made)]


def row(scenario, policy, trial, success, **changes):
    values = {"scenario_sha256": scenario.sha256(), "platform": "fake", "policy": policy, **changes}
    return trial_row(scenario.id, trial, success, **values)


def rows_of(scenario, policy, wins, trials=5):
    return [row(scenario, policy, k, k < wins) for k in range(trials)]


def recovery(scenario, jitter: float = 0.0) -> np.ndarray:
    """(T, 2) float32 actions of the test policy from the recovery point to success."""
    simulator = make_simulator("fake")
    hand_off(simulator, scenario)
    rng, actions = np.random.default_rng(int(jitter * 1000)), []
    while not simulator.succeeded():
        state = simulator.observe()["environment_state"][None]
        actions.append(push_policy({"environment_state": state})[0] + rng.normal(0, jitter, 2).astype("f4"))
        simulator.step(actions[-1])
        assert len(actions) < 400, "the test policy must solve its scenarios"
    return np.array(actions, np.float32)


def trial(scenario, policy, index, success=True, actions=None, **changes) -> LoggedTrial:
    actions = recovery(scenario, jitter=0.01 * index) if actions is None else actions
    values = {"actions_sha256": actions_digest(actions), "steps": len(actions), **changes}
    return LoggedTrial(row(scenario, policy, index, success, **values), actions)


def begun(what: str, count: int) -> list[StageCounts]:
    funnel: list[StageCounts] = []
    add_step(funnel, what, count)
    return funnel


def reasons(funnel: list[StageCounts]) -> dict[str, int]:
    return {reason: n for step in funnel for reason, n in step.dropped}


def test_candidates_are_the_papers():
    """Base below 40 %, an alternative above 60 %: both strictly, invalid trials as failures."""
    a, b, c, d, e, f = scenarios()
    f, g = replace(f, split="test"), replace(fake_scenario(6), split="unscreened")
    rows = [
        *rows_of(a, BASE, 1), *rows_of(a, GOOD, 4), *rows_of(a, FAIR, 3),  # 60 % is not above
        *rows_of(b, BASE, 2), *rows_of(b, GOOD, 5),  # 40 % is not below
        *rows_of(c, BASE, 0), *rows_of(c, GOOD, 4), *rows_of(c, FAIR, 5),
        *rows_of(d, BASE, 0), *rows_of(d, GOOD, 3),
        *rows_of(d, FAIR, 3), row(d, FAIR, 5, False, outcome="sim_error"),
        *rows_of(e, GOOD, 5),
        *rows_of(f, BASE, 0), *rows_of(f, GOOD, 5), *rows_of(g, BASE, 0), *rows_of(g, GOOD, 5),
        *[replace(r, start="initial") for r in rows_of(d, GOOD, 5)],
    ]  # fmt: skip
    funnel = begun("scenarios", 7)
    found = choose_candidates([a, b, c, d, e, f, g], rows, BASE, DonorOptions(), funnel)
    assert {(x.scenario.id, x.policy) for x in found} == {(a.id, GOOD), (c.id, GOOD), (c.id, FAIR)}
    assert reasons(funnel) == {
        "recovered by the base in 40% or more": 1,
        "recovered by no alternative in more than 60%": 1,
        "without a trial of the base": 1,
        "of the test split, which must not train anything": 1,
        "of the unscreened split, which must not train anything": 1,
    }
    assert funnel[-1].kept == 3
    with pytest.raises(ScenarioError, match=r"no trial .* is by 'nobody'"):
        choose_candidates([a], rows, "nobody", DonorOptions(), begun("s", 1))


def chosen_candidates(made, policies=(GOOD, FAIR)):
    rows = [r for s in made for r in rows_of(s, BASE, 0)]
    rows += [r for s in made for p in policies for r in rows_of(s, p, 5)]
    return choose_candidates(made, rows, BASE, DonorOptions(), begun("scenarios", len(made)))


def test_three_of_four_and_all_complete():
    made = scenarios(4)
    candidates = chosen_candidates(made, (GOOD,))
    a, b, c, d = made
    trials = [trial(a, GOOD, k, k != 2) for k in range(4)]
    trials += [trial(b, GOOD, k, k < 2) for k in range(4)]
    trials += [trial(c, GOOD, k) for k in range(3)] + [trial(c, GOOD, 3, False, outcome="timeout")]
    trials += [trial(d, GOOD, k) for k in range(3)]
    funnel = begun("candidates", 4)
    passed = judge(candidates, trials, DonorOptions(), funnel)
    assert [p.candidate.scenario.id for p in passed] == [a.id]
    assert reasons(funnel) == {
        "with fewer than 3 successes in 4": 1,
        "with a trial that did not complete": 1,
        "with fewer than 4 trials": 1,
    }


def test_one_trial_of_a_deterministic_policy_counts_as_all():
    made = scenarios(4)
    candidates = chosen_candidates(made)
    a, b, c, d = made
    options = DonorOptions(deterministic=(GOOD,))
    assert (options.trials_of(GOOD), options.trials_of(FAIR)) == (1, 4)
    trials = [trial(a, GOOD, 0), trial(b, GOOD, 0, False), trial(c, GOOD, 0, False, outcome="timeout")]
    trials += [trial(a, FAIR, k, k != 2) for k in range(4)] + [trial(d, FAIR, 0)]
    funnel = begun("candidates", 8)
    passed = judge(candidates, trials, options, funnel)
    assert {(p.candidate.scenario.id, p.candidate.policy) for p in passed} == {(a.id, GOOD), (a.id, FAIR)}
    assert reasons(funnel) == {
        "with fewer than 3 successes in 4": 1,
        "with a trial that did not complete": 1,
        "with fewer than 1 trial": 1,
        "with fewer than 4 trials": 3,
    }
    ((donor, taken),) = deduplicate(passed, options, funnel)
    assert (donor.candidate.policy, taken.row.trial) == (GOOD, 0), "one of one comes before three of four"
    same = recovery(a)
    repeats = [trial(a, GOOD, k, actions=same) for k in range(4)]
    assert len(judge(candidates, repeats, options, begun("", 0))[0].trials) == 1
    with pytest.raises(ScenarioError, match=f"{GOOD} is said to be deterministic, but trials 0 and 1"):
        judge(candidates, [trial(a, GOOD, k) for k in range(2)], options, begun("", 0))


def test_one_trajectory_per_source_record_and_none_twice():
    made = scenarios(4)
    candidates = chosen_candidates(made)
    same = recovery(made[2])
    trials = [trial(s, GOOD, k, k != 3) for s in made[:2] for k in range(4)]
    trials += [trial(s, FAIR, k) for s in made[:2] for k in range(4)]
    trials += [trial(made[2], GOOD, k, actions=same) for k in range(4)]
    funnel = begun("candidates", len(candidates))
    passed = judge(candidates, trials, DonorOptions(), funnel)
    one = deduplicate(passed, DonorOptions(), funnel)
    by_record = {d.candidate.scenario.cluster: (d.candidate.policy, t.row.trial) for d, t in one}
    assert by_record.keys() == {"rollout-0", "rollout-1"}
    assert by_record["rollout-0"][0] == FAIR, "four successes come before three"
    many = deduplicate(passed, DonorOptions(per_record=3), begun("", 0))
    hashes = [t.row.actions_sha256 for _, t in many]
    assert len(hashes) == len(set(hashes)) == 4, "three of one record; the other has one in four copies"
    assert all(t.row.success for _, t in many)


@pytest.mark.lerobot
def test_written_checked_and_readable_by_lerobot(tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_roborecover.datasets.trajectories import read_trajectories

    made = scenarios(6)
    candidates = chosen_candidates(made, (GOOD,))
    trials = [trial(s, GOOD, k) for s in made[::2] for k in range(4)]
    wrong = recovery(made[0])[:-1]  # one step short of success
    trials = [trial(made[0], GOOD, t.row.trial, actions=wrong) if t.row.scenario_id == made[0].id else t
              for t in trials]  # fmt: skip
    funnel = begun("scenarios", 6)
    passed = judge(candidates, trials, DonorOptions(), funnel)
    chosen = deduplicate(passed, DonorOptions(), funnel)
    assert len(chosen) == 3
    written = write_donors(tmp_path / "d", chosen, simulator={}, workers=1, funnel=funnel)
    assert written == 2
    assert reasons(funnel)["whose replay does not succeed"] == 1
    found = read_trajectories(tmp_path / "d")
    assert found.kind == "donors"
    assert {s.id for s in found.scenarios} == {made[2].id, made[4].id}
    assert {s.split for s in found.scenarios} == {"train"}
    for row_, (_, kept) in zip(found.rows, chosen[1:], strict=True):
        assert row_.first_step == 10
        assert row_.success
        assert row_.provenance["successes"] == 4
        assert row_.steps == len(kept.actions)
    dataset = LeRobotDataset("local/donors", root=tmp_path / "d")
    first = dataset[0]
    assert set(first) >= {"observation.state", "observation.environment_state", "action"}
    np.testing.assert_array_equal(first["action"].numpy(), chosen[1][1].actions[0])
    simulator = make_simulator("fake")
    hand_off(simulator, made[2])
    np.testing.assert_array_equal(
        first["observation.state"].numpy(), simulator.observe()["agent_pos"].astype(np.float32)
    )


def recorded(folder, trials):
    """Trials as `run_trials` leaves them."""
    write_log(folder / "trials.jsonl", [t.row for t in trials])
    (folder / ACTIONS_FOLDER).mkdir()
    for t in trials:
        np.save(actions_path(folder / ACTIONS_FOLDER, t.row), t.actions)
    return folder


@pytest.mark.lerobot
def test_the_command_reads_trials_and_shows_the_funnel(tmp_path, capsys):
    from lerobot_roborecover.cli.main import main

    made = scenarios(4)
    write_scenarios(tmp_path / "set", made, description="train")
    log = write_log(
        tmp_path / "log.jsonl",
        [r for s in made for p, wins in ((BASE, 0), (GOOD, 5)) for r in rows_of(s, p, wins)],
    )
    trials = recorded(tmp_path / "work", [trial(s, GOOD, k) for s in made for k in range(4)])
    command = ["donors", str(log), "--scenarios", str(tmp_path / "set"), "--base", BASE]
    assert main([*command, "--trials-from", str(trials), "--out", str(tmp_path / "out")]) == 0
    table = capsys.readouterr().out
    assert "     4  scenarios of split train" in table
    assert "- 2 of a source record that has its trajectory already" in table
    assert "     2  trajectories that succeed again when replayed" in table
    assert "correction_<type>.yaml --policy.path=<checkpoint> --dataset" in table
    note = json.loads((tmp_path / "out" / "meta" / "roborecover" / "donors.json").read_text())
    assert note["base"] == BASE
    assert [s["count"] for s in note["funnel"]] == [4, 4, 4, 4, 2, 2]

    # One trial that was kept elsewhere is enough of who does the same in every trial.
    one = recorded(tmp_path / "one", [trial(s, GOOD, 0) for s in made])
    once = [*command, "--trials-from", str(one)]
    assert main([*once, "--deterministic", GOOD, "--out", str(tmp_path / "once")]) == 0
    assert "all complete; the one trial of a deterministic policy\n" in capsys.readouterr().out
    note = json.loads((tmp_path / "once" / "meta" / "roborecover" / "donors.json").read_text())
    assert note["options"]["deterministic"] == [GOOD]
    assert main([*once, "--out", str(tmp_path / "four")]) == 2
    assert "4 with fewer than 4 trials" in capsys.readouterr().err
    assert main([*once, "--deterministic", FAIR, "--out", str(tmp_path / "fair")]) == 2
    assert f"neither a --donor, nor one whose trials are in --trials-from; these are {GOOD}" in (
        capsys.readouterr().err
    )

    # A log alone is no donor; nor is a folder that is used already.
    for file in (trials / ACTIONS_FOLDER).iterdir():
        file.unlink()
    assert main([*command, "--trials-from", str(trials), "--out", str(tmp_path / "other")]) == 2
    assert "actions cannot be read" in capsys.readouterr().err
    assert main([*command, "--trials-from", str(trials), "--out", str(tmp_path / "out")]) == 2
    assert "not an empty folder" in capsys.readouterr().err
    assert main([*command, "--out", str(tmp_path / "none")]) == 2
    assert "no trajectory is left" in capsys.readouterr().err


@pytest.mark.lerobot
def test_a_dataset_takes_over_the_statistics_of_the_checkpoint_it_continues(tmp_path):
    from lerobot_roborecover.curation.normalisation import use_statistics_of
    from tests.support.factories import save_policy

    stats = {
        "observation.state": {"mean": [5.0] * 4, "std": [9.0] * 4},
        "action": {"mean": [5.0] * 2, "std": [9.0] * 2},
        "timestamp": {"mean": [7.0]},
    }
    (tmp_path / "d" / "meta").mkdir(parents=True)
    file = tmp_path / "d" / "meta" / "stats.json"
    file.write_text(json.dumps(stats))
    # What `save_policy` saves: means of 0 and deviations of 1.
    assert use_statistics_of(tmp_path / "d", save_policy(tmp_path / "p")) == ["action", "observation.state"]
    found = json.loads(file.read_text())
    assert (found["action"]["mean"], found["action"]["std"]) == ([0.0] * 2, [1.0] * 2)
    assert found["timestamp"] == stats["timestamp"]
    file.write_text(json.dumps(stats | {"action": {"mean": [0.0] * 3}}))
    with pytest.raises(ScenarioError, match="different observation or action"):
        use_statistics_of(tmp_path / "d", tmp_path / "p")


@pytest.mark.parametrize(
    "options", [{"base_below": 1.5}, {"donor_above": 1.0}, {"successes": 5}, {"per_record": 0}]
)
def test_thresholds_that_make_no_sense(options):
    with pytest.raises(ScenarioError, match=r"at least 1|rates are from 0 to 1"):
        DonorOptions(**options)


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
def test_trials_of_a_donor_go_on_after_a_kill(tmp_path):
    """Whenever the process is killed: each trial once, with its actions, as without the kill."""
    policy = save_policy(tmp_path / "policy")
    made = write_scenarios(tmp_path / "set", scenarios())
    program = (
        "import sys; from pathlib import Path\n"
        "from lerobot_roborecover.curation.policy_trials import env_config, run_trials\n"
        "env = env_config('fake', sys.argv[2])\n"
        "run_trials(sys.argv[1], env, Path(sys.argv[3]), trials=8, device='cpu', max_batch=1)"
    )

    def start(folder: Path) -> subprocess.Popen:
        command = [sys.executable, "-c", program, str(policy), str(made), str(folder)]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    log = tmp_path / "killed" / "trials.jsonl"
    killed = start(tmp_path / "killed")
    while not (log.exists() and log.read_bytes().count(b"\n") > 10):
        assert killed.poll() is None, "it ended before it could be killed"
        time.sleep(0.01)
    killed.kill()
    killed.wait()
    before = len(read_trials(tmp_path / "killed"))
    assert before < 48
    for folder in ("killed", "whole"):
        assert start(tmp_path / folder).wait() == 0
    told = [
        {(t.row.scenario_id, t.row.trial): (t.row.outcome, t.row.steps, t.actions.tobytes()) for t in found}
        for found in (read_trials(tmp_path / "killed"), read_trials(tmp_path / "whole"))
    ]
    assert len(read_trials(tmp_path / "killed")) == len(told[0]) == 48
    assert told[0] == told[1]


def test_the_training_command_begins_at_the_base(tmp_path):
    from lerobot_roborecover.cli.donors import _checkpoint, _training_config

    (tmp_path / "config.json").write_text('{"type": "smolvla"}')
    assert _training_config(str(tmp_path)) == "policies/train/correction_smolvla.yaml"
    assert _checkpoint(str(tmp_path)) == str(tmp_path)
    assert _checkpoint("lerobot/pi05_libero") == "lerobot/pi05_libero"
