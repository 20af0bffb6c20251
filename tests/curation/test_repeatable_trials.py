"""Trials whose outcomes are stored are the same again, whichever trials share their batch."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.utils.determinism import KERNELS, has_kernels
from tests.support.factories import fake_dataset, save_policy
from tests.support.processes import PATIENCE_S

pytestmark = pytest.mark.lerobot


def test_a_policys_trials_do_not_depend_on_the_number_of_simulators(tmp_path):
    from lerobot_roborecover.curation.policy_trials import env_config, run_trials

    dataset = fake_dataset(tmp_path / "set", 5, horizon=12)
    policy = str(save_policy(tmp_path / "act"))
    found = [
        run_trials(policy, env_config("fake", str(dataset)), tmp_path / f"slots{slots}", slots=slots)
        for slots in (1, 5)
    ]
    assert [len(trials) for trials in found] == [5, 5]
    assert all(t.row.batch_size == 1 for trials in found for t in trials)
    for alone, beside in zip(*found, strict=True):
        assert (alone.row.outcome, alone.row.steps) == (beside.row.outcome, beside.row.steps)
        assert np.array_equal(alone.actions, beside.actions)


PROGRAM = """
    import hashlib, sys
    from lerobot_roborecover.utils.determinism import pin_policy_kernels

    assert pin_policy_kernels()
    import numpy as np, torch
    from lerobot_roborecover.curation.policy_trials import env_config
    from lerobot_roborecover.evaluation.loading import HostSpec, load_host, policy_config

    assert not pin_policy_kernels(), "torch is loaded: nothing can be chosen any more"
    rng = np.random.default_rng(0)
    def observation():
        numbers = rng.normal(size=77)
        arm = {"pos": rng.normal(size=7), "vel": rng.normal(size=7)}
        eef = {"pos": rng.normal(size=3), "quat": np.array([1.0, 0, 0, 0]), "mat": np.eye(3)}
        hand = {"qpos": rng.normal(size=2), "qvel": rng.normal(size=2)}
        return {"robot_state": {"eef": eef, "gripper": hand, "joints": arm}, "environment_state": numbers}

    observations = [observation() for _ in range(6)]
    env = env_config("libero", "libero_recovery", ["--obs_type=state"])
    policy = policy_config(sys.argv[1], (), "cpu")
    host = load_host(HostSpec(policy, env, max_batch=1, cross_cpu_deterministic=True))
    print(torch.backends.cpu.get_cpu_capability())
    for threads in (1, 2, 4):
        torch.set_num_threads(threads)
        chunks = [host.act([o], ["task"], [host.start(0)])[0] for o in observations]
        print(hashlib.sha256(np.stack(chunks).tobytes()).hexdigest())
"""


@pytest.mark.nightly
def test_a_libero_policys_actions_do_not_depend_on_threads(tmp_path):
    """One observation an inference, with the kernels of the study."""
    policy = Path(__file__).parents[2] / "policies" / "libero" / "act_few"
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(PROGRAM), str(policy)],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        env={k: v for k, v in os.environ.items() if k not in KERNELS},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    capability, *hashes = done.stdout.split()[-4:]  # after what LeRobot prints
    assert not has_kernels() or capability == "AVX2"
    assert len(hashes) == 3
    assert len(set(hashes)) == 1
