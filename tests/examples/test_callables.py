"""The examples of callable policies run, and their actions can be hashed."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import pytest

import lerobot_roborecover as roborecover

EXAMPLES = Path(__file__).parents[2] / "examples" / "callables"
pytestmark = [pytest.mark.lerobot, pytest.mark.metaworld]


@pytest.mark.parametrize(
    ("name", "needs", "steps"),
    [("scripted_expert", "metaworld", 2), ("diffusers_policy", "diffusers", 2), ("jax_policy", "jax", 2)],
)
def test_it_runs(name, needs, steps):
    pytest.importorskip(needs, reason=f"{needs} is not installed: pip install {needs}")
    policy = runpy.run_path(str(EXAMPLES / f"{name}.py"))["policy"]
    scenario = roborecover.load_scenarios("metaworld_starter", select="cell=Place-*")[0]
    short = replace(scenario, task=replace(scenario.task, horizon=steps))
    (row,) = roborecover.evaluate(
        policy, [short], name=name, trials=1, env={"obs_type": "state"}, slots=1, progress=False
    )
    assert (row.outcome, row.steps, row.reason) == ("horizon", steps, "")
    assert row.policy_settings["policy"].startswith("callable@")
    assert "run-" not in row.policy_settings["policy"], "its source can be read whole"
