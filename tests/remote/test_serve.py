"""`roborecover serve` and the `remote` policy: the same rows as with the policy loaded here, and what happens
when the other end misbehaves."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import pytest
import websockets.sync.client

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.policies.remote.protocol import pack, unpack
from lerobot_roborecover.policies.remote.sessions import (
    ENVELOPE,
    Envelope,
    RequestError,
    Sessions,
    read_envelope,
)
from tests.support.loop import outcomes
from tests.support.policy_servers import OpenpiServer, openpi_client, serving  # noqa: F401 - a fixture
from tests.support.serve_loop import (  # noqa: F401 - fixtures
    STATE,
    act,
    checkpoints,
    command,
    dataset,
    diffusion,
    evaluate,
    lerobot_eval,
    load,
    remote,
)

pytestmark = pytest.mark.lerobot


# --- the same rows


def test_act_through_a_server_is_act_here(evaluate, checkpoints, act):
    here = evaluate(f"--policy.path={checkpoints['act']}", "--policy.device=cpu", name="here")
    there = evaluate(*remote(act[0], name="act"), name="there")
    assert outcomes(there) == outcomes(here)
    assert {r.policy for r in there} == {"act"}


def test_history_and_noise_are_the_trials_own_through_a_server(evaluate, checkpoints, diffusion):
    url = diffusion[0]
    here = evaluate(f"--policy.path={checkpoints['diffusion']}", "--policy.device=cpu", name="here")
    there = evaluate(*remote(url), slots=3, name="there")
    assert outcomes(there) == outcomes(here)
    assert {r.noise for r in there} == {"per_trial"}
    assert len({r.actions_sha256 for r in there}) == len(there), "the policy must be stochastic"
    assert {r.policy for r in there} == {f"remote:lerobot@{url}"}


def test_lerobot_eval_gives_the_same_rows_through_a_server(lerobot_eval, checkpoints, diffusion):
    here = lerobot_eval(f"--policy.path={checkpoints['diffusion']}", "--policy.device=cpu", name="here")
    assert outcomes(lerobot_eval(*remote(diffusion[0]), name="there")) == outcomes(here)


def test_a_picture_arrives_as_the_policy_would_see_it_here(checkpoints):
    import torch
    from lerobot.envs import preprocess_observation

    from lerobot_roborecover.policies.remote.mapping import load_mapping
    from lerobot_roborecover.policies.remote.modeling_remote import split
    from lerobot_roborecover.policies.remote.translate import Translator

    pixels = np.random.default_rng(0).integers(0, 256, (2, 16, 24, 3), np.uint8)
    batch = preprocess_observation({"pixels": {"image": pixels}, "agent_pos": np.random.rand(2, 4)})
    frames = [Translator(load_mapping("lerobot")).frame(o) for o in split(batch)[0]]
    assert frames[0]["observation.images.image"].dtype == np.uint8, "a quarter of the bytes"
    frames = [unpack(pack(f)) for f in frames]
    policy = load(checkpoints, "act")
    policy._pre = lambda found: found
    found = policy._prepare(frames, ["", ""])
    for key, value in batch.items():
        assert torch.equal(found[key], value)


# --- openpi's client, and the server's manners


def test_openpis_own_client_gets_the_policys_actions(act, checkpoints, openpi_client):
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    host, port = act[0].removeprefix("ws://").split(":")
    client = WebsocketClientPolicy(host, int(port))
    metadata = client.get_server_metadata()
    assert (metadata["policy_type"], metadata["action_width"], metadata["chunk"]) == ("act", 2, 2)
    assert metadata["observation"] == {"observation.state": [4], "observation.environment_state": [6]}
    answer = client.infer({**STATE, "prompt": "push"})
    host = load(checkpoints, "act")
    (expected,) = host.act([STATE], ["push"], [host.start(0)])
    np.testing.assert_array_equal(answer["actions"], expected)
    assert answer["server_timing"]["infer_ms"] > 0
    with pytest.raises(RuntimeError, match=r"lacks \['observation.environment_state'\]"):
        client.infer({"observation.state": np.zeros(4), "prompt": "push"})
    np.testing.assert_array_equal(client.infer(STATE)["actions"], expected, "one error is one request's")


def test_a_connection_is_a_history_until_it_is_reset(diffusion, checkpoints):
    """Diffusion policies look at two observations and execute four actions."""
    with websockets.sync.client.connect(diffusion[0]) as client:
        client.recv()

        def ask(**extra):
            client.send(pack({**STATE, **extra}))
            return unpack(client.recv())

        actions = [ask()["actions"] for _ in range(5)]
        assert all(a.shape == (1, 2) for a in actions)
        assert ask(reset=True) == {"reset": True}
        envelope = {"session": "mine", "seed": 5}
        first = ask(**{ENVELOPE: {**envelope, "step": 0}})["actions"]
        np.testing.assert_array_equal(ask(**{ENVELOPE: {**envelope, "step": 0}})["actions"], first)
        host = load(checkpoints, "diffusion")
        np.testing.assert_array_equal(first, host.act([STATE], [""], [host.start(5)])[0])
        client.send(pack({**STATE, ENVELOPE: {"session": "mine", "step": 7}}))
        assert "is at step 1, the request says 7" in client.recv()
        assert unpack_of(client, {ENVELOPE: {"session": "mine", "end": True}}) == {"end": True}
        client.send(pack({**STATE, ENVELOPE: {"session": "mine", "step": 1}}))
        assert "session 'mine' is not open" in client.recv()


def unpack_of(client, message):
    client.send(pack(message))
    return unpack(client.recv())


def test_requests_that_come_together_are_inferred_together(checkpoints, monkeypatch):
    policy = load(checkpoints, "act")
    sizes, whole = [], policy.act
    monkeypatch.setattr(policy, "act", lambda o, i, h: sizes.append(len(o)) or whole(o, i, h))
    # The delay is longer than any test may take: only a complete batch is answered.
    with serving(policy, batch_delay_s=600.0) as (url, _), ThreadPoolExecutor(4) as threads:
        clients = [websockets.sync.client.connect(url) for _ in range(4)]
        for client in clients:
            client.recv()
        answers = list(threads.map(lambda c: unpack_of(c, STATE)["actions"], clients))
        for client in clients:
            client.close()
    assert sizes == [4]
    assert all(a.shape == (2, 2) for a in answers)


def bad(**changes):
    return pack({**STATE, **changes})


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (b"\xc1garbage", "not openpi's msgpack"),
        ("text", "a text frame"),
        (pack([1, 2]), "a request is a map"),
        (pack({}), "the observation lacks"),
        (bad(**{"observation.state": np.zeros(5)}), r"shape \(5,\); this policy takes \(4,\)"),
        (bad(**{"observation.state": [0.0] * 4}), "is a list, not an array"),
        (bad(**{"observation.image": np.zeros((3, 8, 8), np.uint8)}), r"a uint8 picture is \(H, W, 3\)"),
        (bad(**{"observation.x": np.zeros((1, 1, 1, 1, 1))}), "has shape"),
        (bad(prompt=5), "the instruction is 5"),
        (bad(**{ENVELOPE: 5}), "it is a map of"),
        (bad(**{ENVELOPE: {"session": ""}}), "a text of 1 to 200"),
        (bad(**{ENVELOPE: {"session": "a", "step": -1}}), "an integer from 0"),
        (bad(**{ENVELOPE: {"session": "a", "pickle": b""}}), "it is a map of"),
    ],
)
def test_garbage_is_answered_in_words_and_the_connection_lives_on(act, message, words):
    with websockets.sync.client.connect(act[0]) as client:
        client.recv()
        client.send(message)
        answer = client.recv()
        assert isinstance(answer, str)
        assert re.search(words, answer)
        assert "Traceback" not in answer
        assert unpack_of(client, STATE)["actions"].shape == (2, 2)


def test_a_frame_over_the_limit_closes_its_connection_alone(act):
    with websockets.sync.client.connect(act[0], max_size=None) as client:
        client.recv()
        with suppress(websockets.exceptions.ConnectionClosed):
            client.send(b"\0" * (2 * 2**20))
        with pytest.raises(websockets.exceptions.ConnectionClosed) as closed:
            client.recv()
        assert closed.value.rcvd.code == 1009
    assert healthy(act[0])


def healthy(url):
    with urllib.request.urlopen(url.replace("ws://", "http://") + "/healthz") as answer:
        return answer.status == 200 and answer.read() == b"OK\n"


def test_who_has_no_key_stays_out(checkpoints, monkeypatch, tmp_path):
    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig
    from lerobot_roborecover.policies.remote.errors import RemoteError
    from lerobot_roborecover.policies.remote.modeling_remote import RemotePolicy

    with serving(load(checkpoints, "act"), api_key="secret") as (url, _):
        assert healthy(url)
        config = RemoteConfig(url=url, mapping="lerobot", wait_s=1)
        with pytest.raises(RemoteError, match=r"HTTP 401.*ROBORECOVER_API_KEY"):
            RemotePolicy(config)
        monkeypatch.setenv("ROBORECOVER_API_KEY", "secret")
        policy = RemotePolicy(config)
        assert policy.server.metadata["policy_type"] == "act"
        policy.server.close()


def test_sessions_beyond_the_limit_end_the_oldest():
    ended = []

    async def start(seed, step):
        return seed

    async def finish(history):
        ended.append(history)

    async def use():
        sessions = Sessions(start, finish, 2)
        for seed, name in enumerate("abc"):
            await sessions.get(Envelope(name, seed))
            await sessions.get(Envelope("a", 9))
        assert ended == [1]
        assert len(sessions) == 2
        with pytest.raises(RequestError, match="'b' is not open, and had 3 requests"):
            await sessions.get(Envelope("b", 1, step=3))

    asyncio.run(use())

    async def go_on():
        sessions = Sessions(start, finish, 2, resumable=True)
        session = await sessions.get(Envelope("b", 1, step=3))
        assert (session.answered, session.history) == (3, 1)
        with pytest.raises(RequestError, match="not open"):
            await sessions.get(Envelope("c", None, step=3))

    asyncio.run(go_on())
    assert read_envelope({}, "own") == Envelope("own")


# --- the command


@pytest.mark.nightly
@pytest.mark.slow
def test_the_command_serves_and_stops_at_ctrl_c(checkpoints, openpi_client):
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    run = "import sys; from lerobot_roborecover.cli.main import main; sys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen(
        [sys.executable, "-c", run, "serve", f"--policy.path={checkpoints['act']}", "--policy.device=cpu",
         "--port=0"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ,
    )  # fmt: skip
    try:
        lines = iter(process.stdout.readline, "")
        line = next(text for text in lines if text.startswith("serving act at ws://127.0.0.1:"))
        url = re.search(r"ws://\S+", line)[0]
        assert healthy(url)
        assert WebsocketClientPolicy(url).infer(STATE)["actions"].shape == (2, 2)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert process.stdout.read().splitlines()[-1] == "stopped after 1 inferences"
    finally:
        process.kill()
        process.stdout.close()


def test_serve_refuses_in_one_line(checkpoints, act, capsys):
    policy = [f"--policy.path={checkpoints['act']}", "--policy.device=cpu"]
    port = act[0].rpartition(":")[2]
    for arguments, words in (
        ([], "no policy: give a checkpoint"),
        ([*policy, "--max_batch=0"], "--max_batch=0: must be from 1"),
        ([*policy, f"--port={port}"], f"cannot listen on 127.0.0.1:{port}"),
    ):
        assert main(["serve", *arguments]) == 2
        assert words in capsys.readouterr().err.splitlines()[-1]
