"""The composite policy: as LeRobot's loop and the fast runner run it, slot by slot, and as users type it."""

from __future__ import annotations

import json
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.launch import EngineConfig, run_work_items
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.session import SimulatorSpec, create_session
from lerobot_roborecover.evaluation.vector_env import create_recovery_envs
from lerobot_roborecover.evaluation.work_items import units_of
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.policies.interventions.options import InterventionFacts
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.workers.messages import SlotConfig
from tests.support.factories import fake_dataset, save_policy
from tests.support.loop import outcomes
from tests.support.small_interventions import HashMonitor

pytestmark = pytest.mark.lerobot

TRIALS = 2
MODES = ("direct", "reversion", "correction", "monitor_reversion", "monitor_correction", "human")
BRIEF_MODES = ("direct", "monitor_correction")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 3, horizon=24)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    return {kind: save_policy(tmp_path_factory.mktemp(kind), kind) for kind in ("act", "diffusion")}


@pytest.fixture
def monitor(monkeypatch):
    from lerobot_roborecover.policies.detectors import loading

    made = HashMonitor()
    monkeypatch.setattr(loading, "load_monitor", lambda *_, **__: made)
    return made


def composite(checkpoints, mode, *, base="act", correction="diffusion", **options):
    """The policy and its processors, as `lerobot-eval` would have them."""
    from lerobot.policies import make_policy, make_pre_post_processors

    from lerobot_roborecover.evaluation.env_configs import ENV_TYPES
    from lerobot_roborecover.policies.interventions.configuration_intervention import (
        MemberConfig,
        MonitorConfig,
        RoboRecoverInterventionConfig,
    )

    config = RoboRecoverInterventionConfig(
        base=MemberConfig(str(checkpoints[base])),
        correction=MemberConfig(str(checkpoints[correction])),
        monitor=MonitorConfig("m"),
        mode=mode,
        correction_steps=7,
        rewind_steps=6,
        device="cpu",
        controller="tests.support.small_interventions:scripted_controller",
        **options,
    )
    policy = make_policy(config, env_cfg=ENV_TYPES["fake"]())
    policy.eval()
    return policy, *make_pre_post_processors(config)


def opened(dataset, log, mode, n_envs=None):
    facts = PolicyMetadata(
        policy="p", n_episodes=TRIALS, intervention=InterventionFacts(mode, 6, {"base": "p"})
    )
    options = RecoveryOptions(scenarios=str(dataset), trial_log=str(log))
    spec = SimulatorSpec(SlotConfig("fake"), {}, None)
    if n_envs:
        return create_recovery_envs(options, spec, n_envs=n_envs, workers=False, facts=facts)
    return create_session(options, spec, workers=True, facts=facts)


def engine_rows(dataset, log, made, mode, slots):
    policy, pre, _ = made
    scenarios, run = opened(dataset, log, mode)
    run.protocol = replace(run.protocol, run_seed=1000)
    run.pool.acquire()
    try:
        host = policy.make_host(lambda b: b, lambda a: a, pre, 64)
        run_work_items(run, units_of(list(scenarios), TRIALS), lambda: host, EngineConfig(slots=slots))
    finally:
        run.pool.release()
    return read_trial_log(log)


def stock_rows(dataset, log, made, mode):
    """LeRobot's own `rollout`, batch 1."""
    from lerobot.scripts.lerobot_eval import rollout

    policy, pre, post = made
    flat = [env for group in opened(dataset, log, mode, n_envs=1).values() for env in group.values()]
    for env in flat:
        for trial in range(TRIALS):
            rollout(env, policy, lambda b: b, lambda a: a, pre, post, seeds=[1000 + trial])
    for env in flat:
        env.close()
    return read_trial_log(log)


def told(rows):
    """The rows' interventions, without what a clock decides."""
    clocks = ("seconds",)
    return {
        (r.scenario_id, r.trial): [{k: v for k, v in e.items() if k not in clocks} for e in r.interventions]
        for r in rows
    }


@pytest.mark.parametrize(
    "mode",
    [*BRIEF_MODES, *(pytest.param(m, marks=pytest.mark.nightly) for m in MODES if m not in BRIEF_MODES)],
)
def test_the_same_rows_as_lerobots_rollout(dataset, checkpoints, monitor, tmp_path, mode):
    """With a correction policy that has an observation queue and draws noise."""
    made = composite(checkpoints, mode)
    stock = stock_rows(dataset, tmp_path / "stock.jsonl", made, mode)
    rows = engine_rows(dataset, tmp_path / "fast.jsonl", made, mode, slots=1)
    assert outcomes(rows) == outcomes(stock)
    assert told(rows) == told(stock)
    assert all(r.reason == "" for r in rows)
    kinds = {e["kind"] for r in rows for e in r.interventions}
    wanted = {"direct": set(), "human": {"monitor", "takeover"}}.get(mode)
    if wanted is None:
        wanted = {"rollback"} if mode.endswith("reversion") else {"correction"}
        wanted |= {"monitor"} if mode.startswith("monitor") else set()
    assert kinds == wanted


def test_a_person_at_the_page_takes_over_under_both_evaluators(
    dataset, checkpoints, monitor, tmp_path, monkeypatch
):
    """They drive three steps forward and hand back; by the page's own websocket."""
    from lerobot_roborecover.web.teleop.client import Client, TeleopRefusal
    from lerobot_roborecover.web.teleop.takeover import Takeover

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    made, taker = composite(checkpoints, "human"), Takeover(0)
    made[0].director._takeover = taker

    def person(client: Client) -> None:
        while not over.is_set():
            try:
                client.ask("status")
                if client.status.get("step", 0) >= 3:
                    client.ask("hand_back")
                else:
                    client.hold([1.0, 0, 0, 0, 0, 0])
            except TeleopRefusal:  # between two trials
                continue
            except ScenarioError:
                assert over.is_set(), "the page's connection broke during a trial"

    over = threading.Event()
    with Client(taker.address) as client:
        driving = threading.Thread(target=person, args=(client,), daemon=True)
        driving.start()
        for rows in (
            stock_rows(dataset, tmp_path / "stock.jsonl", made, "human"),
            engine_rows(dataset, tmp_path / "fast.jsonl", made, "human", slots=1),
        ):
            assert all(r.reason == "" for r in rows)
            steps = [e["steps"] for r in rows for e in r.interventions if e["kind"] == "takeover"]
            assert max(steps) >= 3, "some takeovers end by hand and not with their trial"
        over.set()
    driving.join()


@pytest.mark.nightly
def test_a_trigger_never_reaches_another_slot(dataset, checkpoints, monitor, tmp_path):
    """Four slots at once give what one slot gives; diffusion is asked slot by slot, so bit for bit."""
    made = composite(checkpoints, "monitor_correction", base="diffusion")
    one = engine_rows(dataset, tmp_path / "1.jsonl", made, "monitor_correction", slots=1)
    four = engine_rows(dataset, tmp_path / "4.jsonl", made, "monitor_correction", slots=4)
    assert outcomes(four) == outcomes(one)
    assert told(four) == told(one)
    triggers = {k: v[0]["step"] for k, v in told(one).items()}
    assert len(set(triggers.values())) > 1, "the test needs triggers at different steps"


def test_mode_reversion_and_start_reversion_agree(dataset, checkpoints, tmp_path):
    made = composite(checkpoints, "reversion")
    rolled = engine_rows(dataset, tmp_path / "rolled.jsonl", made, "reversion", slots=1)
    scenarios, run = create_session(
        RecoveryOptions(
            scenarios=str(dataset), trial_log=str(tmp_path / "s.jsonl"), start="reversion", rewind_steps=6
        ),
        SimulatorSpec(SlotConfig("fake"), {}, None), workers=True,
        facts=PolicyMetadata(policy="p", n_episodes=TRIALS),
    )  # fmt: skip
    run.protocol = replace(run.protocol, run_seed=1000)
    run.pool.acquire()
    policy, pre, _ = composite(checkpoints, "direct")
    host = policy.make_host(lambda b: b, lambda a: a, pre, 64)
    run_work_items(run, units_of(list(scenarios), TRIALS), lambda: host, EngineConfig(slots=1))
    run.pool.release()
    started = read_trial_log(tmp_path / "s.jsonl")
    assert {(r.scenario_id, r.trial): (r.outcome, r.steps, r.actions_sha256) for r in rolled} == {
        (r.scenario_id, r.trial): (r.outcome, r.steps, r.actions_sha256) for r in started
    }


# --- as users type it


@pytest.fixture
def lerobot_eval(run_lerobot_eval, dataset, checkpoints, monitor):
    def run(*args, out="out"):
        return run_lerobot_eval(
            "--env", "roborecover_fake", f"--env.scenarios={dataset}", "--eval.use_async_envs=false",
            f"--eval.n_episodes={TRIALS}", "--eval.batch_size=1", *args, out=out,
        )  # fmt: skip

    return run


def test_commands_save_reload_and_resume(lerobot_eval, dataset, checkpoints, monitor, tmp_path, monkeypatch):
    from lerobot_roborecover.cli.main import main

    options = [
        "--policy.type=roborecover_intervention", f"--policy.base.path={checkpoints['act']}",
        f"--policy.correction.path={checkpoints['diffusion']}", "--policy.monitor.path=m",
        "--policy.mode=monitor_correction", "--policy.correction_steps=7",
    ]  # fmt: skip
    log = lerobot_eval(*options) / "trials.jsonl"
    rows = read_trial_log(log)
    assert len(rows) == 3 * TRIALS
    row = rows[0]
    assert row.policy.startswith(f"{checkpoints['act'].name}@")
    assert " monitor_correction(" in row.policy
    assert row.options["intervention"] == "monitor_correction"
    assert row.options["intervention_correction_steps"] == 7
    assert row.execution_horizon == 2

    policy, pre, post = composite(checkpoints, "monitor_correction")
    saved = tmp_path / "saved"
    policy.save_pretrained(saved)
    pre.save_pretrained(saved)
    post.save_pretrained(saved)
    assert json.loads((saved / "config.json").read_text())["correction_steps"] == 7
    again = read_trial_log(lerobot_eval(f"--policy.path={saved}", out="again") / "trials.jsonl")
    assert outcomes(again) == outcomes(rows)
    assert {r.policy for r in again} == {r.policy for r in rows}

    # The fast runner goes on with LeRobot's log, and has nothing left to do with a complete one.
    cut = tmp_path / "cut" / "trials.jsonl"
    cut.parent.mkdir()
    lines = log.read_text().splitlines(keepends=True)
    cut.write_text("".join(lines[:3]))
    monkeypatch.setattr(sys, "argv", ["roborecover"])
    arguments = [
        "eval", "--env", "roborecover_fake", f"--env.scenarios={dataset}", *options, "--policy.device=cpu",
        f"--eval.n_episodes={TRIALS}", "--runner.slots=1", f"--output_dir={cut.parent}",
    ]  # fmt: skip
    assert main(arguments) == 0
    resumed = read_trial_log(cut)
    assert [r.finished_at for r in resumed[:3]] == [r.finished_at for r in rows[:3]]
    assert outcomes(resumed) == outcomes(rows)
    assert told(resumed) == told(rows)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--policy.mode=correction"], "needs --policy.correction.path"),
        (["--policy.mode=undo"], "not one of direct"),
        (["--policy.mode=reversion", "--policy.rewind_steps=0"], "from 1 to"),
        (["--policy.mode=reversion", "--env.start=initial"], "beyond the start"),
        (["--policy.mode=human"], "needs --policy.controller"),
        (["--policy.mode=human", "--policy.controller=nowhere:nothing"], "cannot be made"),
        (["--policy.mode=correction", "--policy.correction.path={wide}"], "its action space is"),
        (["--policy.mode=correction", "--policy.correction.path={camera}"], "trained on cameras"),
        (["--policy.mode=monitor_reversion", "--policy.monitor.path=m"], "gives no observation.images.top"),
        (["--policy.base.n_action_steps=9"], "predicts chunks of 4"),
        (["--policy.base.path=/nowhere/at/all"], "no LeRobot policy there"),
    ],
)
def test_refusals(lerobot_eval, checkpoints, monitor, tmp_path_factory, options, message):
    paths = {}
    if "{wide}" in options[-1]:
        paths["wide"] = save_policy(tmp_path_factory.mktemp("wide"), action=3)
    if "{camera}" in options[-1]:
        paths["camera"] = save_policy(
            tmp_path_factory.mktemp("camera"), env_state=0, images=("observation.images.top",)
        )
    monitor.input_features = {"observation.images.top": None}
    common = ["--policy.type=roborecover_intervention", f"--policy.base.path={checkpoints['act']}"]
    given = [o.format(**paths) for o in options]
    names = {o.split("=")[0] for o in given}
    with pytest.raises(OptionError, match=message):
        lerobot_eval(*(c for c in common if c.split("=")[0] not in names), *given)


def test_a_person_is_not_asked_for_trials_that_are_over(dataset, checkpoints, monitor):
    policy, _, _ = composite(checkpoints, "human")
    import torch

    batch = {"observation.state": torch.zeros(2, 4), "observation.environment_state": torch.zeros(2, 6)}
    with pytest.raises(OptionError, match="batch_size=1"):
        policy.select_action({**batch, "task": ["a", "b"]})


@pytest.mark.parametrize("mode", ["reversion", "correction", "monitor_reversion", "monitor_correction"])
def test_what_ships_for_libero_fits_its_environment(mode):
    """LIBERO's own features name parts of the robot's state, and policies get one vector."""
    from lerobot.policies import make_policy

    from lerobot_roborecover.evaluation.env_configs import ENV_TYPES
    from lerobot_roborecover.policies.interventions.configuration_intervention import (
        MemberConfig,
        MonitorConfig,
        RoboRecoverInterventionConfig,
    )

    root = Path(__file__).parents[2] / "policies"

    def make(**env):
        config = RoboRecoverInterventionConfig(
            base=MemberConfig(str(root / "libero" / "act_few")),
            correction=MemberConfig(str(root / "study" / "libero" / "correction")),
            monitor=MonitorConfig(str(root / "study" / "libero" / "monitor")),
            mode=mode,
            device="cpu",
        )
        return make_policy(config, env_cfg=ENV_TYPES["libero"](**env))

    assert make(obs_type="state").director is not None
    with pytest.raises(OptionError, match=r"observation\.environment_state .*nothing of that name"):
        make()
