"""The `roborecover_robotwin` env type: its options, and `lerobot-eval` through it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.logs.merge import merge
from lerobot_roborecover.logs.trial_log import TrialLogError, read_trial_log
from lerobot_roborecover.platforms import SimulatorError, make_simulator
from lerobot_roborecover.replay.handoff import with_fingerprint
from lerobot_roborecover.scenario import Reset, Scenario, Task
from tests.support.factories import save_policy
from tests.support.loop import evaluate
from tests.support.robotwin_checkouts import ROOT

pytestmark = [pytest.mark.robotwin, pytest.mark.lerobot]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two scenarios of the checkout under test, with three steps each."""
    simulator = make_simulator("robotwin", robotwin_root=ROOT, obs_type="state")
    scenarios = []
    for seed in (3, 4):
        prefix = np.zeros((6, 14))
        prefix[:, [6, 13]] = 1.0
        prefix[:, 1] = np.linspace(0, 0.3, 6)
        scenario = Scenario(
            id=f"s{seed}",
            task=Task("robotwin", "demo_clean", "stack_blocks_two", "Stack green on red.", 3),
            reset=Reset(seed=seed),
            prefix=prefix,
            stage="Approach",
            deviation="Wrong Pose",
            source="natural",
        )
        scenarios.append(with_fingerprint(simulator, scenario))
    simulator.close()
    return write_scenarios(tmp_path_factory.mktemp("robotwin") / "set", scenarios)


def config(**options):
    from lerobot_roborecover.evaluation.env_configs import ENV_TYPES

    return ENV_TYPES["robotwin"](**{"robotwin_root": ROOT, **options})


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"render_quality": "ultra"}, ("render_quality", "trivial")),
        ({"action_mode": "velocity"}, ("action_mode", "joint")),
        ({"action_mode": "ee"}, ("curobo",)),
        ({"obs_type": "state", "videos": True}, ("videos", "state")),
        ({"task": "click_bell"}, ("task", "select")),
        ({"max_parallel_tasks": 2}, ("max_parallel_tasks",)),
    ],
)
def test_options_that_cannot_be_used(options, words):
    from lerobot_roborecover.errors import OptionError

    with pytest.raises(OptionError) as caught:
        config(**options).run_spec()
    for word in words:
        assert word in str(caught.value)


def test_no_checkout_is_said_before_a_simulator_starts(tmp_path, monkeypatch):
    monkeypatch.delenv("ROBOTWIN_ROOT", raising=False)
    with pytest.raises(SimulatorError, match=r"--env\.robotwin_root"):
        config(robotwin_root="").run_spec()
    with pytest.raises(SimulatorError, match="not a RoboTwin checkout"):
        config(robotwin_root=str(tmp_path)).run_spec()


def test_features_are_lerobots_own():
    from lerobot.envs.configs import RoboTwinEnvConfig

    ours, theirs = config(), RoboTwinEnvConfig()
    assert ours.features == theirs.features
    assert ours.features_map == theirs.features_map
    assert set(config(obs_type="state").features) == {"action", "agent_pos"}


def test_the_render_quality_is_part_of_a_trials_identity():
    qualities = [config(render_quality=q).run_spec().decisive["render_quality"] for q in ("rt", "trivial")]
    assert qualities == ["rt", "trivial"]
    assert config(obs_type="state").run_spec().decisive["render_quality"] == "none"


def test_trials_from_approximate_snapshots_are_marked_and_never_mix_with_exact_ones(dataset, tmp_path):
    """A rerun with the option runs its own trials beside those that are there, and nothing joins the two."""

    def rows(log, **options):
        return evaluate(
            dataset,
            tmp_path / log,
            trials=2,
            batch=1,
            spec=config(obs_type="state", **options).run_spec(),
            policy=lambda observation: observation["agent_pos"],
        )

    exact = rows("both.jsonl")
    both = rows("both.jsonl", approximate_snapshots=True)
    marked = [r for r in both if r not in exact]
    assert len(exact) == len(marked) == 4
    assert not any("approximate_snapshots" in r.options or r.handoff_from_snapshot for r in exact)
    assert all(r.options["approximate_snapshots"] and r.handoff_from_snapshot for r in marked)
    assert {r.outcome for r in both} == {"horizon"}
    assert all(r.handoff_identical for r in both)
    assert {r.config_hash for r in exact}.isdisjoint(r.config_hash for r in marked)
    with pytest.raises(TrialLogError, match="option approximate_snapshots"):
        merge([tmp_path / "both.jsonl"], tmp_path / "merged.jsonl")


def test_code_other_than_the_recorded_is_said(dataset, tmp_path, caplog):
    """A warning: the check of every handoff decides whether the difference matters."""
    from lerobot_roborecover import load_scenarios

    scenario = load_scenarios(str(dataset))[0]
    versions = {**scenario.fingerprint.versions, "robotwin_code": "0" * 16}
    changed = replace(scenario, fingerprint=replace(scenario.fingerprint, versions=versions))
    root = write_scenarios(tmp_path / "changed", [changed])
    options = {"obs_type": "state", "scenarios": str(root), "trial_log": str(tmp_path / "log.jsonl")}
    for group in config(**options).create_envs(1, use_async_envs=True).values():
        for env in group.values():
            env.close()
    assert "robotwin_code 0000000000000000" in caplog.text
    assert "robotwin_robot" not in caplog.text


@pytest.mark.nightly
@pytest.mark.render
@pytest.mark.slow
@pytest.mark.usefixtures("vulkan")
def test_an_image_policy_in_worker_processes(run_lerobot_eval, dataset, tmp_path):
    cameras = tuple(f"observation.images.{name}_camera" for name in ("head", "left", "right"))
    policy = save_policy(tmp_path / "policy", "act", state=14, env_state=0, action=14, images=cameras)
    out = run_lerobot_eval(
        "--env", "roborecover_robotwin", f"--env.robotwin_root={ROOT}", f"--env.scenarios={dataset}",
        "--env.render_quality=trivial", f"--policy.path={policy}",
        "--eval.n_episodes=2", "--eval.batch_size=2",
    )  # fmt: skip
    rows = read_trial_log(out / "trials.jsonl")
    assert [(r.outcome, r.steps, r.handoff_identical) for r in rows] == [("horizon", 3, True)] * 4
    assert {r.options["render_quality"] for r in rows} == {"trivial"}
    by_scenario = {r.scenario_id: set() for r in rows}
    for row in rows:
        by_scenario[row.scenario_id].add(row.actions_sha256)
    assert all(len(hashes) == 1 for hashes in by_scenario.values()), "a deterministic policy, the same trial"
