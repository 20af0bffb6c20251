"""`evaluate` with any callable: functions, classes, factories and objects with `reset()`."""

from __future__ import annotations

import logging
import re

import numpy as np
import pytest

import lerobot_roborecover as roborecover
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.pages.media import videos_beside
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.first_trials import PolicyFailedError
from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.factories import fake_dataset
from tests.support.loop import outcomes

pytestmark = pytest.mark.lerobot
QUIET = {"slots": 2, "progress": False, "name": "mine"}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 3, horizon=12)


def toward_the_puck(observation, instruction):
    state = observation["environment_state"]
    return np.clip(3.0 * (state[:2] - observation["agent_pos"][:2]), -1, 1)


def noisy(observation, instruction):
    return np.random.uniform(-1, 1, (3, 2))


class Counting:
    """Gives each action the number of its call, so that a shared history shows."""

    def __init__(self):
        self.calls = 0

    def __call__(self, observation, instruction):
        self.calls += 1
        return np.full(2, self.calls / 100)


class Resettable(Counting):
    def __init__(self):
        self.resets = 0

    def reset(self):
        self.calls, self.resets = 0, self.resets + 1


def test_a_function_is_evaluated_and_named(dataset, tmp_path):
    log = tmp_path / "trials.jsonl"
    rows = roborecover.evaluate(toward_the_puck, dataset, trials=2, log=log, **QUIET)
    assert len(rows) == 6
    assert {r.outcome for r in rows} <= {"success", "horizon"}
    assert {r.policy for r in rows} == {"mine"}
    settings = rows[0].policy_settings
    assert settings["policy_type"] == "callable"
    assert settings["policy"].startswith("callable@")
    assert roborecover.evaluate(toward_the_puck, dataset, trials=2, log=log, **QUIET) == rows, "from the log"
    assert re.fullmatch(
        r"TrialRow\(scenario_id='\S+', start='recovery', trial=0, policy='mine', outcome='\w+', steps=\d+, "
        r"horizon=12\)",
        str(rows[0]),
    )


def test_versions_under_one_name_are_numbered_and_each_has_its_videos(dataset, tmp_path, caplog):
    log, options = tmp_path / "trials.jsonl", {"env": {"obs_type": "state", "videos": True}, **QUIET}
    for policy in (noisy, toward_the_puck):
        with caplog.at_level(logging.WARNING):
            rows = roborecover.evaluate(policy, dataset, trials=1, log=log, **options)
        assert len(list((tmp_path / f"videos_{rows[0].config_hash[:8]}").glob("*_trial0_*.mp4"))) == 3
    short = rows[0].policy_settings["policy"].removeprefix("callable@")[:6]
    assert f"this is version {short} of mine: 3 row(s) of version" in caplog.text
    study = read_study([str(log)])
    first, second = study.policies
    assert re.fullmatch(r"mine \[v1, [0-9a-f]{6}\]", first)
    assert second == f"mine [v2, {short}, newest]"
    rows = {arm.title: arm.rows for arm in study.arms}
    assert [title for title, _ in videos_beside(study.files.items(), rows=rows)] == [first, second]


def test_random_numbers_belong_to_the_trial(dataset):
    state = np.random.get_state()[1].copy()
    rows = roborecover.evaluate(noisy, dataset, trials=1, **QUIET)
    assert np.array_equal(np.random.get_state()[1], state)
    alone = roborecover.evaluate(noisy, dataset, trials=1, **{**QUIET, "slots": 1})
    assert outcomes(rows) == outcomes(alone)
    assert len({r.actions_sha256 for r in rows}) == 3
    assert {r.noise for r in rows} == {"per_trial"}


@pytest.mark.parametrize("policy", [Counting, lambda: Counting()], ids=["class", "factory"])
def test_each_trial_has_an_instance(policy):
    from lerobot_roborecover.policies.callables import CallableRunner

    runner = CallableRunner(policy, width=2)
    trials = [runner.start(0), runner.start(1)]
    asked = [runner.act([{}, {}], ["", ""], trials) for _ in range(2)]
    assert [[chunk[0, 0] for chunk in chunks] for chunks in asked] == [[0.01, 0.01], [0.02, 0.02]]


def test_an_object_is_reset_at_each_handoff(dataset):
    policy = Resettable()
    rows = roborecover.evaluate(policy, dataset, trials=1, **{**QUIET, "slots": 0})
    assert len({r.actions_sha256 for r in rows if r.steps == 12}) == 1
    assert policy.resets == 1 + len(rows), "once before it is hashed, and once a trial"
    with pytest.raises(OptionError, match=r"slots=2.*class"):
        roborecover.evaluate(policy, dataset, trials=1, **QUIET)


def test_chunks_lists_and_tensors_are_arrays():
    import torch

    from lerobot_roborecover.policies.callables import as_chunk

    chunk = as_chunk(torch.ones((12, 2), dtype=torch.bfloat16, requires_grad=True), 2)
    assert (chunk.shape, chunk.dtype) == ((12, 2), np.float32)
    assert as_chunk([0, 0], 2).tolist() == [[0.0, 0.0]]
    exact = np.array([0.1, 0.2])
    assert as_chunk(exact, 2).base is exact, "float64 is executed as it is"


def raises(observation, instruction):
    raise KeyError("front")


@pytest.mark.parametrize(
    ("policy", "words"),
    [
        (lambda o, i: None, "returned None"),
        (lambda o, i: np.zeros(3), r"shape \(3,\); expected \(2,\).*\(n, 2\)"),
        (lambda o, i: np.zeros((0, 2)), r"shape \(0, 2\)"),
        (lambda o, i: np.zeros((1, 1, 2)), r"shape \(1, 1, 2\)"),
        (lambda o, i: {"action": 1}, "object; actions are real numbers"),
        (lambda o, i: [[1.0], [1.0, 2.0]], "is no array"),
        (raises, "KeyError: 'front'"),
        (lambda: 3, "returned a int, which cannot be called"),
    ],
)
def test_a_bad_answer_is_a_policy_error(policy, words):
    from lerobot_roborecover.policies.callables import CallableRunner
    from lerobot_roborecover.policies.runner import PolicyError

    runner = CallableRunner(policy, width=2)
    (answer,) = runner.act([{}], [""], [runner.start(0)])
    assert isinstance(answer, PolicyError)
    assert re.search(words, str(answer)), answer


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": ""}, "name=NAME"),
        ({"policy": lambda observation: 0}, r"\(observation, instruction\)"),
        ({"rename_map": {"a": "b"}}, "rename_map"),
        ({"device": "cpu"}, "device"),
        ({"env": {"videos": True}}, r"evaluate\(..., log=FILE\)"),
        ({"videos": 2}, r"evaluate\(..., log=FILE\)"),
    ],
)
def test_bad_input_is_refused(dataset, changes, words):
    arguments = {"policy": toward_the_puck, "scenarios": dataset, "trials": 1, **QUIET, **changes}
    with pytest.raises(OptionError, match=words):
        roborecover.evaluate(**arguments)


def test_without_a_hash_rows_are_never_reused(dataset, tmp_path, caplog):
    names: dict = {"__name__": "typed_in"}
    exec("def act(o, i): return [0.0, 0.0]", names)
    scenario, log = roborecover.load_scenarios(str(dataset))[:1], tmp_path / "trials.jsonl"
    with caplog.at_level(logging.WARNING):
        (first,) = roborecover.evaluate(names["act"], scenario, trials=1, log=log, **QUIET)
    assert "not reused" in caplog.text
    (second,) = roborecover.evaluate(names["act"], scenario, trials=1, log=log, **QUIET)
    assert first.key() != second.key()


def test_an_unknown_env_option_is_refused_with_the_nearest(dataset):
    with pytest.raises(OptionError, match="there is no option 'obs_typ'; the nearest is 'obs_type'"):
        roborecover.evaluate(
            lambda observation, instruction: [0.0, 0.0], dataset, name="still", env={"obs_typ": "state"}
        )


def test_a_run_whose_first_trials_fail_alike_stops_and_leaves_no_rows(dataset, tmp_path):
    working = [False]

    def act(observation, instruction):
        if not working[0]:
            raise KeyError("observation.state")
        return [0.0, 0.0]

    log = tmp_path / "trials.jsonl"
    with pytest.raises(
        PolicyFailedError,
        match=r"first 3 trials .* KeyError: 'observation.state'.*what a callable is given",
    ):
        roborecover.evaluate(act, dataset, trials=2, log=log, **QUIET)
    assert read_trial_log(log) == []
    with pytest.raises(PolicyFailedError, match="the only trial"):
        roborecover.evaluate(act, dataset, trials=1, log=log, env={"select": "id=*0"}, **QUIET)
    working[0] = True
    rows = roborecover.evaluate(act, dataset, trials=2, log=log, **QUIET)
    assert {r.outcome for r in rows} == {"horizon"}


def test_a_policy_that_acts_in_some_trials_is_measured(dataset):
    calls = [0]

    def act(observation, instruction):
        calls[0] += 1
        return [float("nan"), 0.0] if calls[0] < 3 else [0.0, 0.0]

    rows = roborecover.evaluate(act, dataset, trials=1, **{**QUIET, "slots": 1})
    assert sorted(r.outcome for r in rows) == ["horizon", "policy_error", "policy_error"]
    assert all("non-finite action" in r.reason for r in rows if r.outcome == "policy_error")
