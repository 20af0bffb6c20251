"""On Meta-World the engine, sharded and merged, resumed, or under LeRobot's loop: the same rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.evaluation.launch import EngineConfig, run_work_items
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.session import SimulatorSpec, create_session
from lerobot_roborecover.evaluation.work_items import units_of
from lerobot_roborecover.logs.merge import merge
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.workers.messages import SlotConfig
from tests.evaluation.test_real_trials import reach, short
from tests.support.loop import evaluate, outcomes

TRIALS = 2


class ReachHost:
    """`reach` with noise of each trial's own, a chunk at a time."""

    max_batch, batched = 8, True

    def __init__(self, chunk: int = 1, noise: float = 0.0):
        self._chunk, self._noise = chunk, noise

    def noise(self, seed):
        return "per_trial"

    def start(self, seed):
        return np.random.default_rng(seed)

    def finish(self, history):
        pass

    def act(self, observations, instructions, histories):
        batch = {"environment_state": np.stack([o["environment_state"] for o in observations])}
        actions = np.repeat(reach(batch)[:, None], self._chunk, axis=1)
        noise = [self._noise * h.normal(size=actions.shape[1:]).astype(np.float32) for h in histories]
        return list(actions + np.stack(noise))


def run_engine(root, log, host, *, slots=2, stop=lambda: False, **options):
    scenarios, run = create_session(
        RecoveryOptions(scenarios=str(root), trial_log=str(log), **options),
        SimulatorSpec(SlotConfig("metaworld", {"obs_type": "state"}), {}, None),
        workers=True, facts=PolicyMetadata(policy="push", n_episodes=TRIALS),
    )  # fmt: skip
    run.protocol = replace(run.protocol, run_seed=1000)
    run.pool.acquire()
    try:
        units = units_of(list(scenarios), TRIALS)
        run_work_items(run, units, lambda: host, EngineConfig(slots=slots), stop=stop)
    finally:
        run.pool.release()
    return read_trial_log(log)


@pytest.mark.nightly
@pytest.mark.metaworld
@pytest.mark.slow
def test_every_way_gives_the_same_rows(tmp_path):
    root = short(tmp_path, "metaworld_starter", 2, 20)
    reference = outcomes(
        evaluate(
            root, tmp_path / "loop.jsonl", platform="metaworld", simulator={"obs_type": "state"},
            policy=reach, trials=TRIALS, batch=1,
        )
    )  # fmt: skip
    assert len(reference) == 2 * TRIALS
    assert outcomes(run_engine(root, tmp_path / "engine.jsonl", ReachHost())) == reference

    noisy = {"host": ReachHost(chunk=4, noise=0.2)}
    whole = outcomes(run_engine(root, tmp_path / "whole.jsonl", slots=1, **noisy))
    assert len({sha for _, _, sha, _ in whole.values()}) == len(whole)
    logs = [tmp_path / f"{k}.jsonl" for k in range(2)]
    for k, log in enumerate(logs):
        run_engine(root, log, shard=f"{k}/2", **noisy)
    assert outcomes(merge(logs, tmp_path / "merged.jsonl").rows) == whole
    left = iter(range(20))
    run_engine(root, tmp_path / "r.jsonl", stop=lambda: next(left, None) is None, **noisy)
    assert outcomes(run_engine(root, tmp_path / "r.jsonl", **noisy)) == whole
