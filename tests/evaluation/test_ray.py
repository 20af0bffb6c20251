"""A Ray cluster of two nodes on this machine gives the same rows, also when one node dies in the middle."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.launch import EngineConfig, open_engine
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.session import SimulatorSpec, create_session
from lerobot_roborecover.evaluation.work_items import units_of
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.workers.backend import Backend
from lerobot_roborecover.workers.messages import SlotConfig
from tests.evaluation.test_local_engine import PushHost
from tests.support.factories import fake_dataset, save_policy
from tests.support.loop import evaluate, outcomes
from tests.support.processes import PATIENCE_S
from tests.support.ray_cluster import two_nodes

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.nightly]

TRIALS = 4


@pytest.fixture(scope="module")
def cluster():
    with two_nodes() as nodes:
        yield nodes


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 6)


@pytest.fixture(scope="module")
def reference(dataset, tmp_path_factory):
    return outcomes(evaluate(dataset, tmp_path_factory.mktemp("r") / "log.jsonl", trials=TRIALS, batch=1))


class BlocksOnce(PushHost):
    """Blocks in one inference, the first process that gets there; says what rounding it was told to use."""

    def __init__(self, flag: Path):
        super().__init__()
        self._flag = flag

    def noise(self, seed):
        return os.environ.get("MKL_CBWR", "")

    def act(self, observations, instructions, histories):
        answers = super().act(observations, instructions, histories)
        if len(self.batches) == 5 and not self._flag.exists():
            self._flag.write_text(str(len(observations)))
            threading.Event().wait()
        return answers


def no_policy():
    raise FileNotFoundError("no such checkpoint")


def run_on(
    dataset, log, *, step_s=0.0, obs_type="state", slots=0, on_row=lambda engine: None, make_host=PushHost,
    places=None, **options,
):  # fmt: skip
    """Rows, and how many trials were begun again; `on_row` gets the engine."""
    scenarios, run = create_session(
        RecoveryOptions(scenarios=str(dataset), trial_log=str(log), **options),
        SimulatorSpec(SlotConfig("fake", {"step_s": step_s, "obs_type": obs_type}), {}, None),
        workers=True,
        facts=PolicyMetadata(policy="push", n_episodes=TRIALS),
    )
    run.protocol = replace(run.protocol, run_seed=1000)
    run.pool.acquire()
    try:
        units = units_of(list(scenarios), TRIALS)
        there = EngineConfig(Backend("ray", prefix="--runner.", count="slots"), slots, **(places or {}))
        engine = open_engine(run, units, make_host, there, on_row=lambda row: on_row(engine))
        until = time.monotonic() + PATIENCE_S
        engine.run(units, lambda: time.monotonic() > until)
    finally:
        run.pool.release()
    return read_trial_log(log), engine.reruns


def test_two_nodes_give_the_same_rows(cluster, dataset, reference, tmp_path):
    rows, reruns = run_on(dataset, tmp_path / "log.jsonl")
    assert outcomes(rows) == reference
    assert reruns == 0
    assert {r.noise for r in rows} == {"per_trial"}
    with pytest.raises(OptionError, match=r"9 simulators and 1 .* need 10 CPUs; .* has 4.*slots=3"):
        run_on(dataset, tmp_path / "more.jsonl", slots=9)


class Busy:
    """What others run on a cluster."""

    def there(self):
        return True


def test_simulators_on_all_cpus_do_not_keep_the_policy_out(cluster, dataset, reference, tmp_path):
    """A node may go, or be taken, once the CPUs have been counted."""
    import ray

    busy = ray.remote(num_cpus=1)(Busy).remote()
    assert ray.get(busy.there.remote())
    try:
        rows, _ = run_on(dataset, tmp_path / "log.jsonl", slots=3)
    finally:
        ray.kill(busy)
    assert outcomes(rows) == reference


def test_a_policy_that_dies_costs_the_trials_in_flight_and_they_are_run_again(
    cluster, dataset, reference, tmp_path
):
    done = Counter()

    def kill_once(engine):
        done["rows"] += 1
        if done["rows"] == 5:
            import ray

            ray.kill(engine._replicas[0]._actor)

    rows, reruns = run_on(dataset, tmp_path / "log.jsonl", step_s=0.005, on_row=kill_once)
    assert outcomes(rows) == reference
    assert 1 <= reruns <= 3, "as many as there are simulators"


def test_a_policy_that_blocks_is_replaced_and_the_run_goes_on(
    cluster, dataset, reference, tmp_path, monkeypatch
):
    monkeypatch.setenv("MKL_CBWR", "COMPATIBLE")
    flag = tmp_path / "blocked"
    rows, _ = run_on(
        dataset, tmp_path / "log.jsonl", make_host=partial(BlocksOnce, flag), policy_watchdog_s=30.0
    )
    broken = {key: o for key, o in outcomes(rows).items() if o[0] == "policy_error"}
    assert len(broken) == int(flag.read_text()) >= 1
    assert all("did not answer within 30 s" in r.reason for r in rows if r.outcome == "policy_error")
    assert {**reference, **broken} == outcomes(rows)
    assert {r.noise for r in rows} == {"COMPATIBLE"}, "the replicas round as this process does"


def test_a_simulator_that_cannot_draw_ends_the_run_before_its_first_trial(cluster, dataset, tmp_path):
    """Every simulator makes a picture on its own node first."""
    from lerobot_roborecover.platforms import SimulatorError

    with pytest.raises(SimulatorError, match=r"first simulator on node [0-9.]+ failed: .*render_device=99"):
        run_on(dataset, tmp_path / "a.jsonl", places={"draws": True, "render_device": "99"})
    with pytest.raises(SimulatorError, match=r"first simulator on node [0-9.]+ failed: .*'smell'"):
        run_on(dataset, tmp_path / "b.jsonl", obs_type="smell")
    assert read_trial_log(tmp_path / "a.jsonl") == read_trial_log(tmp_path / "b.jsonl") == []


def test_a_policy_that_cannot_be_loaded_ends_the_run(cluster, dataset, tmp_path):
    with pytest.raises(FileNotFoundError, match="no such checkpoint"):
        run_on(dataset, tmp_path / "a.jsonl", make_host=no_policy)


@pytest.mark.lerobot
@pytest.mark.nightly
def test_the_command_on_a_cluster(cluster, dataset, tmp_path, monkeypatch):
    """The user's own command, with a LeRobot checkpoint loaded on whichever node holds the policy."""
    from lerobot_roborecover.cli.main import main

    policy = save_policy(tmp_path / "policy", "diffusion")
    arguments = [
        "--env", "roborecover_fake", f"--env.scenarios={dataset}", f"--policy.path={policy}",
        "--policy.device=cpu", "--eval.n_episodes=1",
    ]  # fmt: skip
    monkeypatch.setattr(sys, "argv", ["roborecover"])
    assert main(["eval", *arguments, "--engine=ray", f"--output_dir={tmp_path / 'ray'}"]) == 0
    assert main(["eval", *arguments, f"--output_dir={tmp_path / 'local'}"]) == 0
    rows = [read_trial_log(tmp_path / name / "trials.jsonl") for name in ("ray", "local")]
    assert outcomes(rows[0]) == outcomes(rows[1])
    assert len({r.actions_sha256 for r in rows[0]}) == len(rows[0]) == 6


def test_a_node_that_dies_costs_the_trials_in_flight_and_they_are_run_again(
    cluster, dataset, reference, tmp_path
):
    """Whatever was on the node: two simulators, or the policy and one."""
    log = tmp_path / "log.jsonl"
    done = Counter()

    def kill_in_the_middle(engine):
        done["rows"] += 1
        if done["rows"] == 5:
            cluster.lose_a_node()

    rows, reruns = run_on(dataset, log, step_s=0.005, on_row=kill_in_the_middle)
    assert done["rows"] == len(rows) == len(reference)
    assert outcomes(rows) == reference
    assert 1 <= reruns <= 3, "as many as there are simulators"
