"""A policy behind `roborecover serve`, and both evaluators asking it: what tests of the remote policy use."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.factories import fake_dataset, save_policy
from tests.support.policy_servers import OpenpiServer, openpi_client, serving  # noqa: F401 - a fixture

TRIALS = 2
STATE = {"observation.state": np.full(4, 0.1), "observation.environment_state": np.full(6, -0.2)}
FAKE_MAPPING = """
version: 1
about: a server for the fake simulator
state: [{key: state, parts: [{slice: [0, 4]}]}]
actions: {columns: [0, 1], execute: 3}
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 3, horizon=12)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    return {kind: save_policy(tmp_path_factory.mktemp(kind), kind) for kind in ("act", "diffusion")}


def load(checkpoints, kind, max_batch=64, **changes):
    from lerobot.configs.policies import PreTrainedConfig

    from lerobot_roborecover.policies.remote.serve import load_served

    config = PreTrainedConfig.from_pretrained(checkpoints[kind])
    config.pretrained_path = checkpoints[kind]
    for name, value in changes.items():
        setattr(config, name, value)
    return load_served(config, {}, max_batch)


@pytest.fixture(scope="module")
def act(checkpoints):
    with serving(load(checkpoints, "act"), max_frame_bytes=2**20) as found:
        yield found


@pytest.fixture(scope="module")
def diffusion(checkpoints):
    with serving(load(checkpoints, "diffusion")) as found:
        yield found


def command(dataset, out, *policy, slots=1):
    return [
        "--env", "roborecover_fake", f"--env.scenarios={dataset}", f"--eval.n_episodes={TRIALS}",
        f"--output_dir={out}", f"--runner.slots={slots}", *policy,
    ]  # fmt: skip


def remote(url, mapping="lerobot", **options):
    quick = {"wait_s": 1, "reconnect_s": 0.2, "timeout_s": 20, **options}
    return [
        "--policy.type=roborecover_remote", f"--policy.url={url}", f"--policy.mapping={mapping}",
        *(f"--policy.{name}={value}" for name, value in quick.items()),
    ]  # fmt: skip


@pytest.fixture
def evaluate(dataset, tmp_path, monkeypatch):
    """`roborecover eval` in this process: its rows."""

    def call(*policy, slots=1, status=0, name="out"):
        out = tmp_path / name
        monkeypatch.setattr(sys, "argv", ["roborecover"])
        assert main(["eval", *command(dataset, out, *policy, slots=slots)]) == status
        log = out / "trials.jsonl"  # a policy that is refused gets none
        return read_trial_log(log) if log.exists() else []

    return call


@pytest.fixture
def lerobot_eval(dataset, tmp_path, monkeypatch):
    """Stock `lerobot-eval` in this process: its rows."""
    from lerobot.scripts import lerobot_eval as script

    import lerobot_roborecover.plugin as plugin

    def call(*policy, batch=1, name="stock"):
        argv = ["lerobot-eval", *command(dataset, tmp_path / name, *policy)]
        argv = [a for a in argv if not a.startswith("--runner")]
        argv += [f"--eval.batch_size={batch}", "--eval.use_async_envs=false"]
        monkeypatch.setattr(sys, "argv", plugin.rewrite_env_argument(argv))
        script.eval_main()
        return read_trial_log(tmp_path / name / "trials.jsonl")

    return call
