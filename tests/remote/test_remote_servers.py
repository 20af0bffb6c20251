"""The remote policy and servers that are not ours, not there, or not right."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.policies.remote.errors import (
    MappingError,
    ServerUnavailableError,
    SessionExpiredError,
)
from lerobot_roborecover.policies.remote.protocol import pack
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


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    """Pauses between attempts are a thousandth of what they are."""
    monkeypatch.setattr("lerobot_roborecover.policies.remote.connection._FIRST_DELAY_S", 1e-4)


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
        assert [r.outcome for r in rows] == ["horizon"], (
            "a request without an answer is no failure of the policy"
        )
        assert "2 times in a row" in capsys.readouterr().err
        fake.requests.clear()
        alive[0] = True
        fake._infer = lambda r, c: {"actions": np.zeros((3, 2))}
        rows = evaluate(*policy)
    assert [r.outcome for r in rows] == ["horizon"] * 6


def test_a_request_that_nobody_answers_leaves_its_trial_unrun(evaluate, tmp_path, capsys):
    """Others are answered in between, so the run goes on; a trial is tried three times."""
    asked = []

    def infer(request, connection):
        asked.append(0)
        if gone and len(asked) > 6:
            connection.close()
        return {"actions": np.zeros((3, 2))}

    gone = [True]
    fake = OpenpiServer(infer)
    with fake.running() as url:
        policy = remote(url, write_mapping(tmp_path), name="p", give_up_after=0)
        rows = evaluate(*policy, status=1)
        assert {r.outcome for r in rows} == {"horizon"}
        assert len(rows) == 1
        said = capsys.readouterr().err
        assert "5 trials could not be run, and left no row" in said
        gone.clear()
        assert [r.outcome for r in evaluate(*policy)] == ["horizon"] * 6


@pytest.mark.nightly
def test_a_server_that_forgot_a_trial_has_it_run_again(checkpoints, evaluate, tmp_path):
    """The rows are those of a server that forgot nothing: act goes on, diffusion begins its trial anew."""
    for kind in ("act", "diffusion"):
        policy = load(checkpoints, kind)
        with serving(policy) as (url, _):
            whole = evaluate(*remote(url, name=kind), name=f"{kind}-whole")
        with serving(policy) as (url, server):
            forgotten, infer = [], server._infer

            async def forget(content, envelope, infer=infer, server=server, forgotten=forgotten):
                if envelope.step == 2 and len(forgotten) < 2:
                    forgotten.append(envelope.session)
                    await server._sessions.end(envelope.session)
                return await infer(content, envelope)

            server._infer = forget
            rows = evaluate(*remote(url, name=kind), name=f"{kind}-forgot")
        assert len(forgotten) == 2
        assert outcomes(rows) == outcomes(whole), kind
        again = {s for s in forgotten if kind == "diffusion"}
        assert len(set(forgotten)) == 2 or not again


def test_under_lerobot_eval_a_lost_server_ends_the_run(lerobot_eval, tmp_path):
    def infer(request, connection):
        if len(fake.requests) > 6:
            connection.close()
        return {"actions": np.zeros((3, 2))}

    fake = OpenpiServer(infer)
    with fake.running() as url, pytest.raises(ServerUnavailableError, match="closed the connection"):
        lerobot_eval(*remote(url, write_mapping(tmp_path)))


@pytest.mark.nightly
def test_retry_runs_logged_trials_again_and_keeps_the_old_rows(evaluate, tmp_path, capsys):
    import json

    bad = [True]

    def infer(request, connection):
        good = not bad or len(fake.requests) <= 3  # a policy that never acts would stop the run
        return {"actions": np.full((3, 2), 0.0 if good else np.nan)}

    fake = OpenpiServer(infer)
    with fake.running() as url:
        policy = remote(url, write_mapping(tmp_path), name="p")
        assert {r.outcome for r in evaluate(*policy)} == {"policy_error"}
        bad.clear()
        assert {r.outcome for r in evaluate(*policy)} == {"policy_error"}, "a rerun alone keeps what is there"
        assert evaluate(*policy, "--retry=horizon", status=2)
        assert "not one of" in capsys.readouterr().err
        assert {r.outcome for r in evaluate(*policy, "--retry=timeout")} == {"policy_error"}
        rows = evaluate(*policy, "--retry=policy_error,timeout,sim_error")
        assert [r.outcome for r in rows] == ["horizon"] * 6
        assert "6 trials run again" in capsys.readouterr().err
        assert [r.outcome for r in evaluate(*policy, "--retry=policy_error")] == ["horizon"] * 6
    kept = (tmp_path / "out" / "trials.jsonl.retried.jsonl").read_text().splitlines()
    assert [json.loads(line)["outcome"] for line in kept] == ["policy_error"] * 6


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

    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig
    from lerobot_roborecover.policies.remote.modeling_remote import RemotePolicy

    def make(**changes):
        options = {"url": act[0], "mapping": "lerobot", "wait_s": 1, **changes}
        return RemotePolicy(RemoteConfig(**options))

    with pytest.raises(MappingError, match="actions of width 2, the environment takes 7"):
        make(output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))})
    policy = make(output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))})
    with pytest.raises(MappingError, match=r"looks at .*environment_state.*--env.obs_type=state"):
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
    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig
    from lerobot_roborecover.policies.remote.modeling_remote import RemotePolicy

    observation = {k: v.astype(np.float32) for k, v in STATE.items()}
    policy_there = load(checkpoints, "diffusion")
    with serving(policy_there, max_sessions=1) as (url, _):
        policy = RemotePolicy(RemoteConfig(url=url, mapping="lerobot", wait_s=1, connections=1))
        one, two = policy.open_slot(1), policy.open_slot(2)
        for slot, good in ((one, True), (two, True), (one, False)):
            (answer,) = policy.ask([observation], ["push"], [slot])
            assert isinstance(answer, np.ndarray) is good
        assert "is not open, and had 1 requests" in str(answer)
        assert isinstance(answer, SessionExpiredError)
        policy.server.close()


# --- on the real simulator


@pytest.mark.nightly
@pytest.mark.libero
@pytest.mark.render
def test_cosmos_policy_sees_robosuites_own_picture_and_quaternion():
    """From the raw observation through LeRobot's LIBERO processor and the mapping, and back."""
    from lerobot.envs import preprocess_observation

    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.evaluation.env_configs import ENV_TYPES
    from lerobot_roborecover.platforms import SimulatorError, make_simulator
    from lerobot_roborecover.policies.remote.mapping import load_mapping
    from lerobot_roborecover.policies.remote.modeling_remote import split
    from lerobot_roborecover.policies.remote.translate import Translator

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
