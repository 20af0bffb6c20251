"""Forks: the state, the policy's memory and its random stream are the logged trial's."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.analysis.stats.fork_gain import CONTINUE, MATCHED, fork_gains, note_of
from lerobot_roborecover.detection.forks.arms import ForkArm, parse_arm
from lerobot_roborecover.detection.forks.parents import Choice, usable
from lerobot_roborecover.detection.forks.trial import ANOTHER, OWN, Fork, ForkTrial, TeacherForcedRunner
from lerobot_roborecover.errors import OptionError, RoboRecoverError
from lerobot_roborecover.logs.row import (
    ACTIONS_FOLDER,
    EvalProtocol,
    LoggedTrial,
    actions_digest,
    read_actions,
)
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.replay.rollback import RollbackHistory
from lerobot_roborecover.scenario import Outcome, Scenario, ScenarioError
from lerobot_roborecover.workers.recovery_env import RecoveryEnv
from tests.support.factories import fake_dataset, fake_scenario, save_policy
from tests.support.loop import evaluate
from tests.support.trial_rows import trial_row

KINDS = ("act", "diffusion")
HORIZON = 14
BACK = 5


def parent(scenario, actions: np.ndarray, **changes) -> tuple[Scenario, LoggedTrial]:
    values = {
        "scenario_sha256": scenario.sha256(), "actions_sha256": actions_digest(actions), "platform": "fake",
        "steps": len(actions), "horizon": scenario.task.horizon, "handoff_step": len(scenario.prefix),
    }  # fmt: skip
    return scenario, LoggedTrial(trial_row(scenario.id, 0, False, **values | changes), actions)


PROTOCOL = EvalProtocol("recovery", 0, "p", 1000, 1)


# --- without LeRobot


def test_arms_in_words():
    assert parse_arm("rollback:30") == ForkArm("rollback", "30")
    assert parse_arm("human:a.b:c").value == "a.b:c"
    assert parse_arm("fresh").back == 0
    assert parse_arm("rollback:7").back == 7
    for wrong in ("", "again", "rollback", "rollback:0", "rollback:-3", "fresh:2", "policy:", "rollback:1e9"):
        with pytest.raises(OptionError, match=r"--arm="):
            parse_arm(wrong)


def test_a_forks_state_is_the_parents_bit_for_bit():
    """With and without going back, into the prefix as well; and the steps that are left are the parent's."""
    scenario = fake_scenario(1, horizon=30)
    actions = np.random.default_rng(3).uniform(-1, 1, (20, 2)).astype(np.float32)
    whole = RecoveryEnv(scenario)
    whole.reset()
    hashes = [whole.simulator.state_sha256()]
    for action in actions:
        whole.advance(action)
        hashes.append(whole.simulator.state_sha256())
    for step in (0, 4, 19):
        for back in (0, 3, 9):
            arm = ForkArm("rollback", str(back)) if back else ForkArm("fresh")
            trial = ForkTrial(Fork(*parent(scenario, actions), step, arm), PROTOCOL, action_width=2)
            spec = trial.begin()
            env = RecoveryEnv(scenario, spec.start, spec.rewind_steps, played=spec.played, spent=spec.spent)
            env.reset()
            if back <= step:
                assert env.simulator.state_sha256() == hashes[step - back]
            else:  # as a rollback of a running trial goes
                hand_off(whole.simulator, scenario)
                history = RollbackHistory(whole.simulator, scenario.rollout, len(scenario.prefix))
                for action in actions[:step]:
                    history.step(action)
                history.roll_back(back)
                assert env.simulator.state_sha256() == whole.simulator.state_sha256()
            assert trial.steps == step
            assert np.array_equal(trial.actions, actions[:step].reshape(-1, 2))
            left = 0
            while not env.out_of_steps:
                env.advance(np.zeros(2))
                left += 1
            assert left == 30 - step


def test_a_policy_that_does_otherwise_is_found():
    scenario = fake_scenario(0, horizon=20)
    actions = np.zeros((20, 2), np.float32)
    fork = Fork(*parent(scenario, actions), 7, ForkArm(CONTINUE))

    def asked(chunk):
        trial = ForkTrial(fork, PROTOCOL, action_width=2)
        trial.state = "asked"
        return trial, trial.on_actions(chunk, seconds=0.0)

    trial, move = asked(np.full((4, 2), 5e-5, np.float32))
    assert not trial.over
    assert np.array_equal(move.actions, actions[:4])  # what was logged is executed, not what is like it
    for wrong in (np.full((4, 2), 0.01, np.float32), np.full((4, 2), np.nan, np.float32)):
        trial, move = asked(wrong)
        assert move is None
        assert trial.outcome is Outcome.POLICY_ERROR
        assert "cannot be rebuilt" in trial.reason
        assert "max_batch=1" in trial.reason


class SeededHost:
    """Draws its actions from its stream alone, three at a time."""

    max_batch, batched = 8, True

    def noise(self, seed):
        return "per_trial"

    def start(self, seed):
        return [np.random.default_rng(seed)]

    def reseed(self, history, seed):
        history[0] = np.random.default_rng(seed)

    def finish(self, history):
        history.clear()

    def act(self, observations, instructions, histories):
        return [h[0].normal(size=(3, 2)).astype(np.float32) for h in histories]


def test_a_led_history_gets_its_stream_with_the_first_inference_after_the_fork():
    """The chunk that spans the fork's step is the parent's, as its queue was then."""
    one, host = np.random.default_rng(1), TeacherForcedRunner(SeededHost())
    own = [one.normal(size=(3, 2)).astype(np.float32) for _ in range(4)]
    new = np.random.default_rng(9).normal(size=(3, 2)).astype(np.float32)
    for steps, before in ((0, 0), (1, 1), (3, 1), (4, 2)):
        history = host.lead(1, steps, 9)
        chunks = [host.act([None], [""], [history])[0] for _ in range(before + 1)]
        assert all(np.array_equal(a, b) for a, b in zip(chunks, own[:before], strict=False))
        assert np.array_equal(chunks[before], new)
    history = host.lead(1, 4, None)
    assert all(np.array_equal(host.act([None], [""], [history])[0], c) for c in own)


def test_streams_are_matched():
    trial = parent(fake_scenario(0), np.zeros((9, 2), np.float32))
    streams = {Fork(*trial, 4, ForkArm(kind), repeat=0).stream for kind in (CONTINUE, "fresh", "policy")}
    assert len(streams) == 1
    others = {Fork(*trial, step, ForkArm("fresh"), repeat=k).stream for step in (4, 5) for k in range(3)}
    assert len(others) == 6
    assert streams < others
    assert Fork(*trial, 4, ForkArm(CONTINUE), on=OWN).stream is None
    assert Fork(*trial, 4, ForkArm(CONTINUE), on=ANOTHER).stream not in {None, *others}


def test_which_trials_and_which_steps():
    rows = [
        trial_row("a", 0, True, steps=10), trial_row("a", 1, False, steps=60),
        trial_row("a", 2, False, steps=60, interventions=[{"kind": "rollback", "step": 1}]),
        trial_row("b", 0, outcome="sim_error"), trial_row("b", 1, True, run_seed=None),
        trial_row("b", 2, True, options={"fork": {}}),
    ]  # fmt: skip
    kept, dropped = usable([(Path("f"), r) for r in rows], Choice())
    assert [(r.scenario_id, r.trial) for _, r in kept] == [("a", 0), ("a", 1)]
    assert dropped.total() == 4
    assert dropped["is a fork itself"] == 1
    assert [r.trial for _, r in usable([(Path("f"), r) for r in rows], Choice(of="failures"))[0]] == [1]
    assert [r.trial for _, r in usable([(Path("f"), r) for r in rows], Choice(trials=1))[0]] == [0]
    trial = LoggedTrial(rows[1], np.zeros((60, 2)))
    assert Choice(every=25).steps(trial) == [0, 25, 50]
    assert Choice(every=30).steps(trial) == [0, 30]  # at 60 it was over
    assert Choice(at=(59, 60, 5, 5)).steps(trial) == [5, 59]
    with pytest.raises(ScenarioError, match="stride 0"):
        Choice(every=0)


def test_every_loop_keeps_actions_for_who_asks(tmp_path):
    """LeRobot's loop, in batches; with rollbacks, what was undone as well."""
    root = fake_dataset(tmp_path / "set", 2, horizon=12)
    evaluate(root, tmp_path / "not" / "log.jsonl", trials=2, batch=2)
    assert not (tmp_path / "not" / ACTIONS_FOLDER).exists()
    rows = evaluate(root, tmp_path / "log.jsonl", trials=2, batch=2, record_actions=True)
    for row in rows:
        assert read_actions(tmp_path / ACTIONS_FOLDER, row).shape == (row.steps, 2)
    with pytest.raises(ScenarioError, match=r"--env\.record_actions=true"):
        read_actions(tmp_path / "not" / ACTIONS_FOLDER, rows[0])


# --- with policies


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    root = tmp_path_factory.mktemp("policies")
    return {kind: save_policy(root / kind, kind) for kind in KINDS}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("forks") / "set", 2, horizon=HORIZON)


@pytest.fixture(scope="module")
def logs(policies, dataset, tmp_path_factory):
    """A log of each policy, with actions."""
    from lerobot_roborecover.curation.policy_trials import env_config, run_trials

    found = {}
    for kind, policy in policies.items():
        folder = tmp_path_factory.mktemp(f"log-{kind}")
        trials = run_trials(str(policy), env_config("fake", str(dataset)), folder, slots=2, max_batch=1)
        found[kind] = folder / "trials.jsonl", {t.row.scenario_id: t for t in trials}
    return found


def forked(policies, logs, kind, out, arms=(), **options):
    from lerobot_roborecover.detection.forks.run import ForkRequest, run_forks

    choice = options.pop("choice", Choice(at=(0, 1, 6, 13)))
    arms = [parse_arm(arm) for arm in arms]
    request = ForkRequest([logs[kind][0]], str(policies[kind]), out, arms, choice, slots=2, **options)
    return run_forks(request)


MEASURED = {"finished_at", "handoff_s", "sim_s", "policy_s", "handoff_from_snapshot"}


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
def test_a_deterministic_policys_continuations_are_taken_from_the_log(policies, logs, tmp_path, capsys):
    """As they would be if they had been run; one that is continued to check says whether that is so."""
    from lerobot_roborecover.cli.main import main

    run = forked(policies, logs, "act", tmp_path / "run", ["fresh"])
    taken = forked(policies, logs, "act", tmp_path / "taken", ["fresh"], deterministic=True)

    def plain(found):
        rows = sorted((r for r in found.rows if note_of(r).stream == MATCHED), key=lambda r: r.key())
        return [{k: v for k, v in asdict(r).items() if k not in MEASURED} for r in rows]

    assert plain(taken) == plain(run)
    assert fork_gains(taken.rows).reproduced == (1, 1)
    assert len(read_trial_log(taken.log)) == len(taken.rows) == 8 + 1 + 8
    for row in taken.rows:
        assert len(read_actions(taken.log.with_name(ACTIONS_FOLDER), row)) >= row.steps
    again = forked(policies, logs, "act", tmp_path / "taken", ["fresh"], deterministic=True)
    assert again.rows == taken.rows
    # A policy that draws is found out, whatever its own random stream repeats.
    command = [
        "fork",
        str(logs["diffusion"][0]),
        f"--policy={policies['diffusion']}",
        "--at=0,6",
        "--slots=2",
    ]
    assert main([*command, f"--out={tmp_path / 'drawn'}", "--arm=fresh", "--deterministic"]) == 1
    assert "1 of 1 of its trials end otherwise" in capsys.readouterr().err


@pytest.mark.lerobot
@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_continuing_reproduces_the_rest_of_the_trial(policies, logs, kind, tmp_path, monkeypatch):
    """From every kind of step: the handoff, within a chunk, between chunks, the last; a policy that keeps a
    queue and draws noise as well as one that does not. Row and actions are the parent's."""
    from lerobot_roborecover.detection.forks import run

    def own(parents, arm, request):
        return [Fork(s, p, step, arm, on=OWN) for s, p in parents for step in request.choice.steps(p)]

    monkeypatch.setattr(run, "forks_of", own)
    found = forked(policies, logs, kind, tmp_path)
    assert len(found.rows) == 8
    of_the_run = {"run_scenarios", "run_trials", "shard"}
    apart = {"options", "config_hash", *of_the_run, *MEASURED}
    for row in found.rows:
        logged = logs[kind][1][row.scenario_id].row
        assert {k: v for k, v in asdict(row).items() if k not in apart} == {
            k: v for k, v in asdict(logged).items() if k not in apart
        }
        assert row.actions_sha256 == logged.actions_sha256


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
def test_every_arm(policies, logs, dataset, tmp_path):
    """Arms that are the same under two names give the same actions: streams, states and budgets are one."""
    from lerobot_roborecover.curation.policy_trials import env_config, run_trials

    kind = "diffusion"
    arms = [
        "fresh", f"policy:{policies[kind]}", f"rollback:{BACK}", f"correction:{policies['act']}",
        "human:tests.support.small_interventions:scripted_controller",
    ]  # fmt: skip
    found = forked(policies, logs, kind, tmp_path / "out", arms, choice=Choice(at=(0, 6)), correction_steps=3)
    by: dict[tuple, dict] = {}
    for row in found.rows:
        note = note_of(row)
        own = " own" if note.stream == "own" else ""
        key = note.arm.partition(":")[0] + own
        by.setdefault((row.scenario_id, note.step), {})[key] = row
    assert len(by) == 4
    folder = found.log.with_name(ACTIONS_FOLDER)
    logged = logs[kind][1]
    for (scenario, step), rows in by.items():
        acts = {arm: read_actions(folder, row) for arm, row in rows.items()}
        before = logged[scenario].actions[:step]
        assert all(np.array_equal(a[:step], before) for a in acts.values())
        assert all(r.steps <= HORIZON and r.outcome in ("success", "horizon") for r in rows.values())
        # Another name of the same policy: the same stream, and the same fresh history.
        assert np.array_equal(acts["fresh"], acts["policy"])
        assert not np.array_equal(acts["fresh"], acts["rollback"])
        assert rows["rollback"].interventions == [
            {"kind": "rollback", "step": step, "by": "fork", "asked": BACK, "distance": BACK,
             "undone": min(BACK, step)}
        ]  # fmt: skip
        assert rows["correction"].interventions[0] | {"steps": 3} == rows["correction"].interventions[0]
        assert rows["correction"].interventions[0]["step"] == step
        took = rows["human"].interventions[0]
        assert (took["kind"], took["step"]) == ("takeover", step)
        driven = acts["human"][step : step + took["steps"]]
        assert len(driven)
        assert np.array_equal(driven, np.tile(np.float32([-1.0, 0.25]), (len(driven), 1)))
        # On the new stream the noise is another, after the queue of before is used up.
        assert not np.array_equal(acts["continue"], logged[scenario].actions)
    middle = [rows["continue own"] for rows in by.values() if "continue own" in rows]
    assert {r.scenario_id: r.actions_sha256 for r in middle} == {
        i: t.row.actions_sha256 for i, t in logged.items()
    }
    # Where nothing is drawn, going back at the handoff is Reversion.
    back = forked(policies, logs, "act", tmp_path / "act", [f"rollback:{BACK}"], choice=Choice(at=(0,)))
    env = env_config("fake", str(dataset), ["--start=reversion", f"--rewind_steps={BACK}"])
    reverted = run_trials(str(policies["act"]), env, tmp_path / "reversion", max_batch=1)
    assert {r.scenario_id: r.actions_sha256 for r in back.rows if note_of(r).arm != CONTINUE} == {
        t.row.scenario_id: t.row.actions_sha256 for t in reverted
    }


@pytest.mark.lerobot
@pytest.mark.slow
def test_the_command(policies, logs, tmp_path, capsys):
    """Resumes, takes more arms in, writes its page, and refuses what it cannot fork."""
    from lerobot_roborecover.cli.main import main

    log, trials = logs["act"]
    head = ["fork", str(log), f"--policy={policies['act']}", f"--out={tmp_path / 'out'}", "--slots=2"]
    assert main([*head, "--arm", "fresh", "--every", "8"]) == 0
    out = capsys.readouterr().out
    assert "2 of 2 logged trials end as they did" in out
    assert "By step of the trial" in out
    before = read_trial_log(tmp_path / "out" / "trials.jsonl")
    assert len(before) == 2 * (2 + 2 + 1)
    assert main([*head, "--arm", "fresh", "--arm", "rollback:2", "--every", "8"]) == 0
    after = read_trial_log(tmp_path / "out" / "trials.jsonl")
    assert after[: len(before)] == before
    assert len(after) == len(before) + 4
    for name in ("gain.html", "gain.md", "fork_gain.png", "fork_gain_by_step.csv"):
        assert (tmp_path / "out" / name).stat().st_size

    def refused(*argv) -> str:
        assert main([*head, *argv]) == 2
        return capsys.readouterr().err

    bare = tmp_path / "bare" / "trials.jsonl"
    bare.parent.mkdir()
    bare.write_bytes(log.read_bytes())
    assert main(["fork", str(bare), *head[2:]]) == 2
    assert "--env.record_actions=true" in capsys.readouterr().err
    assert "Name the checkpoint that ran them" in refused("--policy", str(policies["diffusion"]))
    assert "n_action_steps=2" in refused("--policy-option", "n_action_steps=3")
    other = refused("--rename_map", '{"observation.image": "observation.images.top"}')
    assert "other settings of the policy than here (there / here: rename_map null / " in other
    assert "option handoff_check True" in refused("--env", "handoff_check=false")
    assert "--steps=x" in refused("--steps", "x")
    assert "no trial is left" in refused("--of", "successes" if not any(
        t.row.success for t in trials.values()) else "failures")  # fmt: skip


def test_a_log_without_the_scenarios_is_refused():
    from lerobot_roborecover.detection.forks.parents import with_actions

    scenario = fake_scenario(0)
    row = parent(scenario, np.zeros((3, 2), np.float32))[1].row
    with pytest.raises(RoboRecoverError, match="no such scenario"):
        with_actions([(Path("f"), row)], {})
    other = replace(scenario, prefix=scenario.prefix[:-1], fingerprint=None)
    with pytest.raises(RoboRecoverError, match="another scenario"):
        with_actions([(Path("f"), row)], {scenario.id: other})
