"""The public functions: `evaluate` on checkpoints and on objects, in a training loop, and `report`."""

from __future__ import annotations

import inspect
import operator
import random
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lerobot_roborecover as roborecover
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_dataset, fake_scenario, save_policy
from tests.support.loop import outcomes

EXAMPLE = Path(__file__).parents[2] / "examples" / "training" / "evaluate_while_training.py"
pytestmark = pytest.mark.lerobot
QUIET = {"slots": 2, "max_batch": 1, "progress": False}
"""One observation an inference: it then rounds alike, whatever other trials wait."""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 3, horizon=12)


@pytest.fixture(scope="module")
def act(tmp_path_factory):
    return save_policy(tmp_path_factory.mktemp("act"))


@pytest.fixture(scope="module")
def trained(act):
    """A policy object and its processors, as a training loop has them."""
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies import get_policy_class, make_pre_post_processors

    config = PreTrainedConfig.from_pretrained(act)
    policy = get_policy_class("act").from_pretrained(act, config=config)
    policy.train()
    return policy, make_pre_post_processors(config, pretrained_path=str(act))


def test_an_object_and_its_checkpoint_give_the_same_trials(dataset, act, trained, tmp_path):
    policy, _ = trained
    log = tmp_path / "trials.jsonl"
    saved = roborecover.evaluate(act, dataset, trials=2, log=log, **QUIET)
    assert [(r.scenario_id, r.trial) for r in saved] == [
        (s.id, k) for s in roborecover.load_scenarios(str(dataset)) for k in range(2)
    ]
    assert saved[0].policy.startswith(f"{act.name}@")
    assert saved[0].execution_horizon == 2
    scenarios = list(roborecover.load_scenarios(str(dataset)))[1:]
    given = roborecover.evaluate(policy, scenarios, trials=2, processors=act, **QUIET)
    assert given[0].policy.startswith("act@")
    assert outcomes(given) == {k: v for k, v in outcomes(saved).items() if k[0] != saved[0].scenario_id}
    again = roborecover.evaluate(act, dataset, trials=2, log=log, **QUIET)
    assert again == saved, "the log holds them"
    made = roborecover.report({"mine": log}, tmp_path / "report")
    assert made.files.html.exists()
    assert "mine" in made.files.markdown.read_text()


def test_a_training_loop_goes_on_as_if_nothing_had_been(dataset, trained):
    import torch

    policy, processors = trained
    policy.train()
    frozen = next(m for m in policy.modules() if isinstance(m, torch.nn.Dropout))
    frozen.eval()
    modes = [m.training for m in policy.modules()]
    weights = {k: v.clone() for k, v in policy.state_dict().items()}
    torch.manual_seed(5), np.random.seed(5), random.seed(5)
    before = torch.rand(3), np.random.rand(3), random.random()
    torch.manual_seed(5), np.random.seed(5), random.seed(5)
    switches = torch.backends.cudnn.benchmark, torch.backends.cuda.matmul.allow_tf32
    logged = []
    callback = roborecover.EvaluationCallback(
        dataset, 10, lambda metrics, step: logged.append((step, metrics)), starts=("recovery", "initial"),
        options={"trials": 1, **QUIET},
    )  # fmt: skip
    for step in range(11):
        callback(step, policy, processors)
    after = torch.rand(3), np.random.rand(3), random.random()
    assert [m.training for m in policy.modules()] == modes
    assert torch.equal(before[0], after[0])
    assert np.array_equal(before[1], after[1])
    assert before[2] == after[2]
    assert switches == (torch.backends.cudnn.benchmark, torch.backends.cuda.matmul.allow_tf32)
    assert all(torch.equal(v, weights[k]) for k, v in policy.state_dict().items())
    ((step, metrics),) = logged
    assert step == 10
    assert metrics["recovery/trials"] == metrics["initial/trials"] == 3
    assert all(isinstance(v, float) for v in metrics.values())
    assert {"recovery/success", "recovery/cell/Approach-Wrong_Pose"} <= set(metrics)
    assert "recovery/macro" not in metrics, "no cell has seven scenarios"
    batch = {
        "observation.state": torch.zeros(2, 4), "observation.environment_state": torch.zeros(2, 6),
        "action": torch.zeros(2, 4, 2), "action_is_pad": torch.zeros(2, 4, dtype=torch.bool),
    }  # fmt: skip
    loss, _ = policy.forward(batch)
    loss.backward()


def test_a_policys_weights_are_its_name(trained):
    import torch

    from lerobot_roborecover.policies.identity import object_identity

    policy, _ = trained
    before = object_identity(policy)
    assert before == object_identity(policy)
    parameter = next(policy.parameters())
    with torch.no_grad():
        parameter.add_(1e-3)
        assert object_identity(policy) != before
        parameter.sub_(1e-3)


def test_on_meta_world(tmp_path):
    scenario = roborecover.load_scenarios("metaworld_starter")[0]
    short = replace(scenario, task=replace(scenario.task, horizon=6))
    policy = save_policy(tmp_path / "act", env_state=39, action=4)
    rows = roborecover.evaluate(policy, [short], env={"obs_type": "state"}, trials=1, **QUIET)
    assert [(r.outcome, r.steps, r.handoff_identical) for r in rows] == [("horizon", 6, True)]


@pytest.mark.nightly
def test_the_example_runs_without_an_account(capsys):
    main = runpy.run_path(str(EXAMPLE))["main"]
    (logged,) = main(["--steps", "1", "--eval-freq", "1", "--scenarios", "1", "--horizon", "3"])
    assert logged["recovery/trials"] == logged["initial/trials"] == 1
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("step 1: "))
    assert "recovery/success 0" in line


@pytest.mark.parametrize(("tracker", "log"), [("wandb", "sdk.wandb_run.Run.log"), ("trackio", "log")])
def test_trackers_take_the_call(tracker, log):
    module = pytest.importorskip(tracker, reason=f"{tracker} is not installed: pip install {tracker}")
    taken = inspect.signature(operator.attrgetter(log)(module))
    metrics = {"recovery/success": 0.5}
    taken.bind(*(() if "self" not in taken.parameters else (None,)), metrics, step=10)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"trials": 0}, "trials=0"),
        ({"scenarios": []}, "load_scenarios"),
        ({"policy": object()}, "LeRobot policy"),
        ({"env": {"start": "middle"}}, "middle.*recovery"),
        ({"env": {"nonsense": 1}}, "nonsense"),
        ({"policy": "/nowhere/at/all"}, "/nowhere/at/all"),
    ],
)
def test_bad_input_is_refused_in_words(dataset, act, changes, words):
    arguments = {"policy": act, "scenarios": dataset, "trials": 1, **QUIET, **changes}
    with pytest.raises((OptionError, ScenarioError), match=words):
        roborecover.evaluate(**arguments)


def test_an_object_without_processors_is_refused(dataset, trained):
    policy, _ = trained
    path, policy.config.pretrained_path = policy.config.pretrained_path, None
    try:
        with pytest.raises(OptionError, match="processors"):
            roborecover.evaluate(policy, dataset, trials=1, **QUIET)
    finally:
        policy.config.pretrained_path = path


def test_scenarios_of_two_platforms_are_refused(dataset, act):
    ours, other = fake_scenario(0), roborecover.load_scenarios("metaworld_starter")[0]
    with pytest.raises(ScenarioError, match="metaworld"):
        roborecover.evaluate(act, [ours, other], trials=1, **QUIET)
