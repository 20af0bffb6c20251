"""The benchmark of `examples/vla_eval` in the real harness: the trials that our own client makes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.factories import fake_dataset
from tests.support.policy_servers import vla_eval, vla_eval_harness  # noqa: F401 - fixtures
from tests.support.serve_loop import evaluate, remote  # noqa: F401 - fixtures
from tests.support.vla_eval_server import model_server

pytestmark = pytest.mark.lerobot

EXAMPLE = Path(__file__).parents[2] / "examples" / "vla_eval"
MAPPING = """
version: 1
about: a vla-eval server for the fake simulator
protocol: vla_eval
state:
  - {key: states, parts: [{slice: [0, 4]}, {source: observation.environment_state}]}
prompt: {key: task_description}
specs: {action: {position: delta_xy}, observation: {state: everything}}
actions: {execute: 1}
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 3, horizon=40)


@pytest.fixture
def example(vla_eval_harness, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield
    sys.modules.pop("roborecover_vla_eval", None)


def pusher(obs):
    """Goes around the puck and pushes it at the goal; on some scenarios that is enough."""
    mass, puck, goal = obs["states"][:2], obs["states"][6:8], obs["states"][8:10]
    toward = (goal - puck) / max(np.linalg.norm(goal - puck), 1e-6)
    across = np.array([-toward[1], toward[0]])
    along, beside = (mass - puck) @ toward, (mass - puck) @ across
    target = goal if along < 0 and abs(beside) < 0.03 else puck - 0.11 * toward
    if along > -0.04:
        target = puck + across * (np.sign(beside) or 1.0) * 0.13 - 0.05 * toward
    return np.clip(8.0 * (target - mass), -1.0, 1.0)


def run(url, tmp_path, dataset, name="out", server=None, **params):
    """The harness, as `vla-eval run` starts it; its result."""
    import anyio
    from vla_eval.orchestrator import Orchestrator

    config = yaml.safe_load((EXAMPLE / "libero.yaml").read_text())
    config |= {"server": {"url": url, "timeout": 20}, "output_dir": str(tmp_path / name)}
    (entry,) = config["benchmarks"]
    entry |= {"name": "fake", "episodes_per_task": 2, **(server or {})}
    entry["params"] = {
        "platform": "fake", "mapping": str(tmp_path / "fake.yaml"), "policy": "p",
        "trial_log": str(tmp_path / f"{name}.jsonl"), "env": {"scenarios": str(dataset)}, **params,
    }  # fmt: skip
    (tmp_path / "fake.yaml").write_text(MAPPING)
    (result,) = anyio.run(Orchestrator(config).run)
    return result, read_trial_log(tmp_path / f"{name}.jsonl")


def test_the_harness_makes_the_trials_that_our_client_makes(example, evaluate, dataset, tmp_path):
    with model_server(pusher) as (url, told):
        result, rows = run(url, tmp_path, dataset)
        ours = evaluate(*remote(url, str(tmp_path / "fake.yaml"), name="p"))

    def facts(found):
        return {(r.scenario_id, r.trial): (r.outcome, r.steps, r.actions_sha256) for r in found}

    assert facts(rows) == facts(ours)
    assert {r.outcome for r in rows} == {"success", "horizon"}
    assert result["num_errors"] == 0
    assert result["mean_success"] == pytest.approx(np.mean([r.success for r in rows]), abs=1e-4)
    assert {t["task"]: t["mean_success"] for t in result["tasks"]} == {
        s: np.mean([r.success for r in rows if r.scenario_id == s]) for s in {r.scenario_id for r in rows}
    }
    starts = [config["task"] for kind, config in told if kind == "start"]
    assert starts[0]["instruction"] == "push the puck to the goal"
    assert starts[0]["stage"] == "Approach"


def test_what_says_nothing_of_the_policy_is_an_error_there(example, dataset, tmp_path):
    with model_server(lambda obs: np.zeros(3)) as (url, _):
        result, rows = run(url, tmp_path, dataset, server={"max_tasks": 1})
        assert {r.outcome for r in rows} == {"policy_error"}
        assert "width 3; the environment takes 2" in rows[0].reason
        assert result["num_errors"] == 2
    with model_server(lambda obs: np.zeros(2)) as (url, _):
        result, rows = run(url, tmp_path, dataset, "cut", server={"max_tasks": 1, "max_steps": 5})
        assert (result["num_errors"], rows) == (2, [])
        (task,) = result["tasks"]
        assert "leave max_steps out" in task["episodes"][0]["failure_detail"]
        again = [run(url, tmp_path, dataset, "twice", server={"max_tasks": 1})[1] for _ in range(2)]
        assert again[0] == again[1]
        assert len(again[0]) == 2


def test_a_mapping_of_another_protocol_is_refused(example):
    from roborecover_vla_eval import RecoveryBenchmark

    from lerobot_roborecover.errors import RoboRecoverError

    with pytest.raises(RoboRecoverError, match="openpi_libero: is for openpi"):
        RecoveryBenchmark(mapping="openpi_libero")


@pytest.mark.nightly
@pytest.mark.metaworld
def test_metaworld_in_the_harness(example, tmp_path):
    (tmp_path / "meta.yaml").write_text(
        "version: 1\nabout: Meta-World\nprotocol: vla_eval\nstate: [{key: states, parts: [{}]}]\n"
        "prompt: {key: task_description}\nactions: {execute: 1}\n"
    )
    with model_server(lambda obs: np.zeros(4)) as (url, _):
        result, rows = run(
            url, tmp_path, "", platform="metaworld", mapping=str(tmp_path / "meta.yaml"),
            env={"obs_type": "state", "select": "id=assembly-v3-perturbed-expert-weak-grip-0"},
            server={"episodes_per_task": 1},
        )  # fmt: skip
    assert result["num_errors"] == 0
    assert [r.outcome for r in rows] == ["horizon"]
