"""The remote policy and servers that are not ours, not there, or not right."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.remote.errors import MappingError, ServerAwayError
from lerobot_roborecover.remote.protocol import pack
from tests.support.loop import outcomes
from tests.support.policy_servers import OpenpiServer, openpi_client, serving  # noqa: F401 - a fixture
from tests.support.serve_loop import (  # noqa: F401 - fixtures
    FAKE_MAPPING,
    STATE,
    TRIALS,
    act,
    checkpoints,
    dataset,
    diffusion,
    evaluate,
    lerobot_eval,
    load,
    remote,
)

pytestmark = pytest.mark.lerobot


def write_mapping(tmp_path, text=FAKE_MAPPING):
    (tmp_path / "fake.yaml").write_text(text)
    return str(tmp_path / "fake.yaml")


def test_an_openpi_server_gives_rows(evaluate, lerobot_eval, tmp_path):
    """Chunks of ten, of which three are executed; by both ways in."""
    fake = OpenpiServer(lambda r, c: {"actions": np.tile(r["state"][:2], (10, 2))})
    with fake.running() as url:
        rows = evaluate(*remote(url, write_mapping(tmp_path), n_action_steps=4))
        stock = lerobot_eval(*remote(url, write_mapping(tmp_path), n_action_steps=4), batch=2)
    assert outcomes(rows) == outcomes(stock)
    assert {(r.outcome, r.steps, r.noise, r.execution_horizon) for r in rows} == {
        ("horizon", 12, "unseeded", 4)
    }
    assert len(fake.requests) == 2 * 3 * TRIALS * 3, "three requests a trial"
    assert fake.requests[0]["prompt"] == "push the puck to the goal"


def test_a_server_that_wants_the_last_step_gets_it(evaluate, lerobot_eval, tmp_path):
    fake = OpenpiServer(lambda r, c: {"actions": np.tile(r["window"][0]["state"][:2], (3, 1))})
    mapping = write_mapping(tmp_path, FAKE_MAPPING + "window: {frames: 2, key: window}\n")
    with fake.running() as url:
        rows = evaluate(*remote(url, mapping))
        requests, fake.requests = fake.requests, []
        assert outcomes(lerobot_eval(*remote(url, mapping))) == outcomes(rows)
    assert len(requests) == len(fake.requests) == 3 * TRIALS * 4
    first, second = (tuple(s["state"] for s in r["window"]) for r in requests[:2])
    np.testing.assert_array_equal(*first)
    assert not np.array_equal(*second)


def test_bad_answers_are_rows(evaluate, tmp_path):
    bad = {
        "non-finite action": {"actions": np.full((10, 2), np.nan)},
        "actions of width 1": {"actions": np.zeros((10, 1))},
        "2 actions, fewer than the 3": {"actions": np.zeros((2, 2))},
        "an error: ValueError: no such prompt": "Traceback\nValueError: no such prompt",
        "dtype '|O8'": pack({"actions": np.zeros(2)}).replace(b"<f8", b"|O8"),
        "has no 'actions'": {"action": np.zeros((10, 2))},
    }
    answers = iter(bad.values())
    with OpenpiServer(lambda r, c: next(answers)).running() as url:
        rows = evaluate(*remote(url, write_mapping(tmp_path)))
    assert {r.outcome for r in rows} == {"policy_error"}
    assert len(rows) == 3 * TRIALS == len(bad)
    for row, reason in zip(rows, bad, strict=True):
        assert reason in row.reason


def test_under_lerobot_eval_a_failed_request_costs_its_trial(lerobot_eval, tmp_path):
    def infer(request, connection):
        return "KeyError: 'x'" if len(fake.requests) == 2 else {"actions": np.zeros((3, 2))}

    fake = OpenpiServer(infer)
    with fake.running() as url:
        rows = lerobot_eval(*remote(url, write_mapping(tmp_path)), batch=2)
    assert sorted(r.outcome for r in rows) == ["horizon"] * 5 + ["policy_error"]


def test_a_server_that_stays_away_ends_the_run_and_the_same_command_goes_on(evaluate, tmp_path, capsys):
    alive = [True]

    def infer(request, connection):
        if len(fake.requests) > 6:
            alive[0] = False
        if not alive[0]:
            connection.close()
        return {"actions": np.zeros((3, 2))}

    fake = OpenpiServer(infer)
    with fake.running() as url:
        policy = remote(url, write_mapping(tmp_path), name="p", give_up_after=2)
        rows = evaluate(*policy, status=2)
        assert [r.outcome for r in rows] == ["horizon", "policy_error"]
        assert "closed the connection" in rows[-1].reason
        assert "2 times in a row" in capsys.readouterr().err
        fake.requests.clear()
        alive[0] = True
        fake._infer = lambda r, c: {"actions": np.zeros((3, 2))}
        rows = evaluate(*policy)
    assert [r.outcome for r in rows] == ["horizon", "policy_error", *["horizon"] * 4]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"mapping": "lerobbot"}, "lerobbot: neither one of"),
        ({"mapping": "lerobot", "url": "ws://127.0.0.1:9"}, "no policy server at"),
    ],
)
def test_refusals_run_nothing(evaluate, capsys, act, options, words):
    rows = evaluate(*remote(**{"url": act[0], "wait_s": 0, **options}), status=2)
    assert rows == []
    errors = capsys.readouterr().err.splitlines()
    assert words in errors[-1]


def test_a_policy_for_another_platform_is_refused(act, diffusion):
    import torch
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_roborecover.remote.configuration_remote import RemoteConfig
    from lerobot_roborecover.remote.modeling_remote import RemotePolicy

    def make(**changes):
        options = {"url": act[0], "mapping": "lerobot", "wait_s": 1, **changes}
        return RemotePolicy(RemoteConfig(**options))

    with pytest.raises(MappingError, match="actions of width 2, the environment takes 7"):
        make(output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))})
    policy = make(output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))})
    with pytest.raises(MappingError, match=r"looks at .*environment_state.*the environment gives"):
        policy.select_action({"observation.state": torch.zeros(1, 4), "task": ["push"]})
    batch = {
        "observation.state": torch.zeros(2, 4),
        "observation.environment_state": torch.zeros(2, 6),
        "task": ["a", "b"],
    }
    assert policy.predict_action_chunk(batch).shape == (2, 2, 2)
    assert next(policy.parameters()).device.type == "cpu"
    policy.server.close()
    with (
        OpenpiServer(lambda r, c: {}, {"model": "pi0"}).running() as url,
        pytest.raises(MappingError, match=r"is for 'roborecover serve'.*'model': 'pi0'"),
    ):
        make(url=url)


def test_a_trial_whose_server_was_started_again_is_not_continued(checkpoints, tmp_path):
    from lerobot_roborecover.remote.configuration_remote import RemoteConfig
    from lerobot_roborecover.remote.modeling_remote import RemotePolicy

    observation = {k: v.astype(np.float32) for k, v in STATE.items()}
    policy_there = load(checkpoints, "diffusion")
    with serving(policy_there, max_sessions=1) as (url, _):
        policy = RemotePolicy(RemoteConfig(url=url, mapping="lerobot", wait_s=1, connections=1))
        one, two = policy.open_slot(1), policy.open_slot(2)
        for slot, good in ((one, True), (two, True), (one, False)):
            (answer,) = policy.ask([observation], ["push"], [slot])
            assert isinstance(answer, np.ndarray) is good
        assert "is not open, and had 1 requests" in str(answer)
        assert not isinstance(answer, ServerAwayError)
        policy.server.close()


# --- on the real simulator


@pytest.mark.nightly
@pytest.mark.libero
@pytest.mark.render
def test_cosmos_policy_sees_robosuites_own_picture_and_quaternion():
    """From the raw observation through LeRobot's LIBERO processor and the mapping, and back."""
    from lerobot.envs import preprocess_observation

    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.env.configs import ENV_TYPES
    from lerobot_roborecover.platforms import SimulatorError, make_simulator
    from lerobot_roborecover.remote.mapping import load_mapping
    from lerobot_roborecover.remote.modeling_remote import split
    from lerobot_roborecover.remote.translate import Translator

    try:
        simulator = make_simulator("libero", observation_height=64, observation_width=64)
    except SimulatorError as err:
        pytest.skip(str(err))
    scenario = load_scenarios("libero_starter")[0]
    simulator.reset(scenario.task, scenario.reset)
    raw = simulator.observe()
    config = ENV_TYPES["libero"](observation_height=64, observation_width=64)
    batch = preprocess_observation(_batch_of_one(raw))
    frames = split({**config.get_env_processors()[0](batch), "task": ["pick it up"]})[0]
    request = Translator(load_mapping("cosmos_policy")).frame(frames[0])
    eef = raw["robot_state"]["eef"]
    np.testing.assert_array_equal(request["primary_image"], raw["pixels"]["image"][::-1])
    np.testing.assert_array_equal(request["wrist_image"], raw["pixels"]["image2"][::-1])
    gripper = raw["robot_state"]["gripper"]["qpos"]
    np.testing.assert_allclose(
        request["proprio"], np.concatenate([gripper, eef["pos"], eef["quat"]]), atol=1e-6
    )
    simulator.close()


def _batch_of_one(value):
    if isinstance(value, dict):
        return {key: _batch_of_one(v) for key, v in value.items()}
    return np.asarray(value)[None]
