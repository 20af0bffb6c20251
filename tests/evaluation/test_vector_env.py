"""A trial's result depends on the trial alone: not on batch, workers, order, shard, resume, or neighbours."""

from __future__ import annotations

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.evaluation.session import EvalSession
from lerobot_roborecover.evaluation.vector_env import ScenarioVectorEnv
from lerobot_roborecover.logs.fields import TRIAL_SCHEMA
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.workers.messages import SlotConfig
from lerobot_roborecover.workers.slots import SlotPool
from tests.support.factories import fake_dataset, fake_scenario
from tests.support.loop import evaluate, outcomes, push_policy

TRIALS = 4


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 6)


@pytest.fixture(scope="module")
def reference(dataset, tmp_path_factory):
    rows = evaluate(dataset, tmp_path_factory.mktemp("ref") / "log.jsonl", trials=TRIALS, batch=1)
    assert len(rows) == 6 * TRIALS
    assert {r.outcome for r in rows} == {"success", "horizon"}, "the policy must both succeed and fail"
    assert all(r.handoff_identical and r.handoff_eef_error_mm == 0.0 for r in rows)
    return outcomes(rows)


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(
    batch=st.sampled_from([1, 2, 4]),
    reverse=st.booleans(),
    stop=st.integers(0, 12),
    resumed_batch=st.sampled_from([1, 2, 4]),
)
def test_batch_order_and_resume_change_nothing(
    dataset, reference, tmp_path_factory, batch, reverse, stop, resumed_batch
):
    log = tmp_path_factory.mktemp("p") / "log.jsonl"
    first = evaluate(dataset, log, trials=TRIALS, batch=batch, reverse=reverse, stop_after_batches=stop)
    rows = evaluate(dataset, log, trials=TRIALS, batch=resumed_batch)
    assert outcomes(rows) == reference
    assert rows[: len(first)] == first, "finished trials are kept as they were"


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(parts=st.integers(2, 6))
def test_shards_together_are_the_whole(dataset, reference, tmp_path_factory, parts):
    folder = tmp_path_factory.mktemp("s")
    merged = {}
    for k in range(parts):
        rows = evaluate(dataset, folder / f"{k}.jsonl", trials=TRIALS, batch=2, shard=f"{k}/{parts}")
        part = outcomes(rows)
        assert not merged.keys() & part.keys()
        merged |= part
    assert merged == reference


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, 2])
def test_worker_processes_change_nothing(dataset, reference, tmp_path, batch):
    rows = evaluate(dataset, tmp_path / "log.jsonl", trials=TRIALS, batch=batch, workers=True)
    assert outcomes(rows) == reference


def test_batch_that_does_not_divide_runs_no_surplus_trial(dataset, reference, tmp_path):
    rows = evaluate(dataset, tmp_path / "log.jsonl", trials=TRIALS, batch=3)
    assert outcomes(rows) == reference


def test_snapshot_and_replay_agree(dataset, reference, tmp_path):
    keep = tmp_path / "snapshots"
    evaluate(dataset, tmp_path / "a.jsonl", trials=1, batch=1, snapshot_dir=str(keep))
    rows = evaluate(dataset, tmp_path / "b.jsonl", trials=TRIALS, batch=1, snapshot_dir=str(keep))
    assert all(r.handoff_from_snapshot for r in rows), (
        "the second run must start from the first one's snapshots"
    )
    assert outcomes(rows) == reference


def test_a_damaged_snapshot_is_replayed_instead(dataset, reference, tmp_path):
    keep = tmp_path / "snapshots"
    evaluate(dataset, tmp_path / "a.jsonl", trials=1, batch=1, snapshot_dir=str(keep))
    for file in keep.iterdir():
        data = bytearray(file.read_bytes())
        data[-20] ^= 0xFF
        file.write_bytes(data)
    rows = evaluate(dataset, tmp_path / "b.jsonl", trials=TRIALS, batch=1, snapshot_dir=str(keep))
    assert outcomes(rows) == reference


@pytest.mark.parametrize(("start", "step"), [("initial", 2), ("reversion", 6)])
def test_starts(dataset, tmp_path, start, step):
    rows = evaluate(dataset, tmp_path / "log.jsonl", trials=1, batch=1, start=start, rewind_steps=4)
    assert {r.handoff_step for r in rows} == {step}
    assert {r.rewind_steps for r in rows} == {4 if start == "reversion" else 0}


@pytest.mark.parametrize(
    ("platform", "horizon", "steps"),
    [("libero", 520, 30), ("metaworld", 500, 30), ("robotwin", 400, 30), ("robotwin", 500, 60)],
)
def test_the_papers_reversion(platform, horizon, steps):
    assert platform_named(platform).rewind_steps(horizon) == steps


def test_reversion_goes_back_by_the_papers_rule_unless_told(dataset, tmp_path):
    log = tmp_path / "log.jsonl"
    rows = evaluate(dataset, log, trials=1, batch=1, start="reversion")
    assert {(r.rewind_steps, r.handoff_step, r.options["rewind_rule"]) for r in rows} == {(30, 2, "paper")}
    again = evaluate(dataset, log, trials=1, batch=1, start="reversion")
    assert again == rows
    told = evaluate(dataset, log, trials=1, batch=1, start="reversion", rewind_steps=4)
    assert {r.rewind_steps for r in told} == {4, 30}
    assert len(told) == 2 * len(rows)


def test_reversion_never_goes_before_the_start(dataset, tmp_path):
    rows = evaluate(dataset, tmp_path / "log.jsonl", trials=1, batch=1, start="reversion", rewind_steps=500)
    assert {r.handoff_step for r in rows} == {2}


@pytest.mark.parametrize(
    ("platform", "width", "bound"), [("libero", 7, 1.0), ("metaworld", 4, 1.0), ("robotwin", 14, np.inf)]
)
def test_actions_have_the_platforms_bounds(platform, width, bound):
    task = replace(fake_scenario(0).task, platform=platform)
    scenario = replace(fake_scenario(0), task=task, prefix=np.zeros((4, width)), fingerprint=None)
    pool = SlotPool(SlotConfig(platform), workers=False, timeout_s=1.0)
    env = ScenarioVectorEnv(scenario, 3, EvalSession(pool, None, None, "", None))
    assert env.single_action_space == gym.spaces.Box(-bound, bound, (width,), np.float32)
    assert env.action_space.shape == (3, width)
    beyond = np.full(width, 2.4, np.float32)
    assert env.single_action_space.contains(beyond) is (platform == "robotwin")


def test_starts_share_a_log(dataset, tmp_path):
    log = tmp_path / "log.jsonl"
    evaluate(dataset, log, trials=1, batch=1)
    rows = evaluate(dataset, log, trials=1, batch=1, start="initial")
    assert sorted({r.start for r in rows}) == ["initial", "recovery"]
    assert len(rows) == 12


def test_replayed_actions_do_not_count(dataset, tmp_path):
    rows = evaluate(dataset, tmp_path / "log.jsonl", trials=1, batch=1, policy=lambda o: push_policy(o) * 0)
    assert {(r.outcome, r.steps, r.horizon) for r in rows} == {("horizon", 45, 45)}


def test_moved_object_is_a_state_mismatch_and_the_policy_never_acts(tmp_path):
    from dataclasses import replace

    from lerobot_roborecover.scenario import Pose

    scenario = fake_scenario(0)
    bodies = dict(scenario.fingerprint.bodies)
    x, y, z = bodies["puck"].position_m
    bodies["puck"] = Pose((x + 0.0025, y, z), bodies["puck"].quat_xyzw)
    moved = replace(scenario, fingerprint=replace(scenario.fingerprint, bodies=bodies))
    root = write_scenarios(tmp_path / "set", [moved])
    log = tmp_path / "log.jsonl"
    (row,) = evaluate(root, log, trials=1, batch=1)
    assert (row.outcome, row.steps, row.success) == ("state_mismatch", 0, False)
    assert row.handoff_object_error_mm == pytest.approx(2.5)
    assert "puck is 2.50 mm" in row.reason
    (unchecked,) = evaluate(root, tmp_path / "b.jsonl", trials=1, batch=1, handoff_check=False)
    assert unchecked.outcome in ("success", "horizon")


def test_non_finite_and_misshapen_actions_become_policy_errors(dataset, tmp_path):
    def broken(observation):
        action = push_policy(observation)
        action[0] = float("nan")
        return action

    rows = evaluate(dataset, tmp_path / "log.jsonl", trials=2, batch=2, policy=broken)
    by_trial = {(r.scenario_id, r.trial): r for r in rows}
    assert all(
        r.outcome == "policy_error" and "non-finite" in r.reason for (_, k), r in by_trial.items() if k == 0
    )
    assert all(r.outcome in ("success", "horizon") for (_, k), r in by_trial.items() if k == 1)
    rows = evaluate(dataset, tmp_path / "c.jsonl", trials=1, batch=1, policy=lambda o: push_policy(o)[:, :1])
    assert all(r.outcome == "policy_error" and "(2,)" in r.reason for r in rows)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "outcome", "words"),
    [
        pytest.param("raises", "sim_error", "broke on purpose", marks=pytest.mark.nightly),
        pytest.param("exits", "sim_error", "exit status 3", marks=pytest.mark.nightly),
        ("hangs", "timeout", "did not answer within 2 s"),
    ],
)
def test_a_broken_worker_costs_its_trial_and_nothing_else(tmp_path, task, outcome, words):
    good, bad = fake_scenario(0), fake_scenario(1, name=task, suite="faults")
    root = write_scenarios(tmp_path / "set", [good, bad])
    rows = evaluate(root, tmp_path / "log.jsonl", trials=2, batch=2, workers=True, watchdog_s=2.0)
    for row in rows:
        if row.scenario_id == bad.id:
            assert row.outcome == outcome
            assert words in row.reason
        else:
            assert row.outcome in ("success", "horizon")
    assert len(rows) == 4


def test_a_prefix_that_breaks_the_simulator_is_a_row_too(tmp_path):
    from dataclasses import replace

    bad = fake_scenario(1, name="raises", suite="faults")
    import numpy as np

    long = replace(bad, prefix=np.zeros((30, 2)), fingerprint=None)
    root = write_scenarios(tmp_path / "set", [long])
    (row,) = evaluate(root, tmp_path / "log.jsonl", trials=1, batch=1, workers=True)
    assert row.outcome == "sim_error"
    assert row.reason.startswith("at the handoff")


def test_a_prefix_that_solves_the_task_is_said_so(tmp_path):
    from dataclasses import replace

    import numpy as np

    from lerobot_roborecover.platforms import make_simulator

    scenario = fake_scenario(1)
    simulator = make_simulator("fake")
    simulator.reset(scenario.task, scenario.reset)
    actions = []
    while not simulator.succeeded():
        state = simulator.observe()["environment_state"][None]
        actions.append(push_policy({"environment_state": state})[0].astype(np.float64))
        simulator.step(actions[-1])
    solved = replace(scenario, prefix=np.array(actions), fingerprint=None)
    root = write_scenarios(tmp_path / "set", [solved])
    (row,) = evaluate(root, tmp_path / "log.jsonl", trials=1, batch=1)
    assert (row.outcome, row.success, row.steps) == ("solved_by_prefix", False, 0)


def test_rows_say_how_noise_was_drawn(dataset, tmp_path):
    one = evaluate(dataset, tmp_path / "a.jsonl", trials=2, batch=1)
    two = evaluate(dataset, tmp_path / "b.jsonl", trials=2, batch=2)
    assert {r.noise for r in one} == {"per_trial"}
    assert {r.noise for r in two} == {"per_batch"}
    assert [r.trial_seed for r in one] == [r.trial_seed for r in two]
    assert len({r.trial_seed for r in one}) == 12


def test_log_lines_are_plain_json_with_everything_a_table_needs(dataset, tmp_path):
    log = tmp_path / "log.jsonl"
    evaluate(dataset, log, trials=1, batch=1)
    record = json.loads(log.read_text().splitlines()[0])
    assert record["dataset"] == str(dataset)
    assert {
        "stage",
        "deviation",
        "source",
        "policy",
        "config_hash",
        "versions",
        "finished_at",
    } <= record.keys()
    row = read_trial_log(log)[0]
    assert row.schema == TRIAL_SCHEMA
    assert (row.run_scenarios, row.run_trials, row.shard) == (6, 1, "0/1")
