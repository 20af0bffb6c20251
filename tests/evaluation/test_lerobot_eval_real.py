"""`lerobot-eval` on the real simulators, with small random policies of the platforms' own features."""

from __future__ import annotations

from dataclasses import replace

import pytest

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.exactness import row_as_recorded
from tests.support.factories import save_policy
from tests.support.loop import outcomes

pytestmark = [pytest.mark.lerobot, pytest.mark.slow]


def short(root, name: str, count: int, horizon: int):
    """The first scenarios of a shipped set, each with a small budget."""
    return write_scenarios(
        root, [replace(s, task=replace(s.task, horizon=horizon)) for s in list(load_scenarios(name))[:count]]
    )


@pytest.mark.nightly
@pytest.mark.libero
@pytest.mark.render
def test_an_image_policy_on_libero(run_lerobot_eval, tmp_path):
    cameras = ("observation.images.image", "observation.images.image2")
    policy = save_policy(tmp_path / "policy", "act", state=8, env_state=0, action=7, images=cameras)
    out = run_lerobot_eval(
        "--env", "roborecover_libero",
        f"--env.scenarios={short(tmp_path / 'set', 'libero_starter', 1, 3)}",
        "--env.observation_height=64", "--env.observation_width=64", f"--policy.path={policy}",
        "--eval.n_episodes=2", "--eval.batch_size=2",
    )  # fmt: skip
    rows = read_trial_log(out / "trials.jsonl")
    assert [(r.outcome, r.steps, row_as_recorded(r)) for r in rows] == [("horizon", 3, True)] * 2
    assert rows[0].actions_sha256 == rows[1].actions_sha256
    assert rows[0].options["observation_height"] == 64
    assert list((out / "videos").rglob("*.mp4"))


@pytest.mark.nightly
@pytest.mark.metaworld
def test_a_stock_stochastic_policy_on_metaworld(run_lerobot_eval, tmp_path):
    """At batch 1 a trial is the same whatever ran before it: alone, after others, in a shard, resumed."""
    policy = save_policy(tmp_path / "policy", "diffusion", state=4, env_state=39, action=4)
    common = (
        "--env=roborecover_metaworld", "--env.obs_type=state", f"--policy.path={policy}",
        f"--env.scenarios={short(tmp_path / 'set', 'metaworld_starter', 3, 12)}",
        "--eval.n_episodes=2", "--eval.batch_size=1",
    )  # fmt: skip
    whole = read_trial_log(run_lerobot_eval(*common) / "trials.jsonl")
    assert len({r.actions_sha256 for r in whole}) == 6
    shards = []
    for k in range(2):
        out = run_lerobot_eval(*common, f"--env.shard={k}/2", "--eval.use_async_envs=false", out=f"s{k}")
        shards += read_trial_log(out / "trials.jsonl")
    assert outcomes(shards) == outcomes(whole)
    partial = tmp_path / "partial.jsonl"
    lines = (tmp_path / "out" / "trials.jsonl").read_text().splitlines(keepends=True)
    partial.write_text("".join(lines[1::2]))
    run_lerobot_eval(*common, f"--env.trial_log={partial}", out="r")
    assert outcomes(read_trial_log(partial)) == outcomes(whole)


@pytest.mark.metaworld
@pytest.mark.render
def test_an_image_policy_on_metaworld(run_lerobot_eval, tmp_path):
    policy = save_policy(
        tmp_path / "policy", "act", state=4, env_state=0, action=4, images=("observation.image",)
    )
    out = run_lerobot_eval(
        "--env=roborecover_metaworld",
        f"--env.scenarios={short(tmp_path / 'set', 'metaworld_starter', 1, 2)}",
        "--env.observation_height=64", "--env.observation_width=64", f"--policy.path={policy}",
        "--eval.n_episodes=1",
    )  # fmt: skip
    (row,) = read_trial_log(out / "trials.jsonl")
    assert (row.outcome, row.steps, row_as_recorded(row)) == ("horizon", 2, True)
