"""`examples/maniskill`: a simulator from outside, as a platform of its own distribution."""

from __future__ import annotations

import ast
import importlib.util
import io
import os
import tokenize
import tomllib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml

from lerobot_roborecover.datasets import read_scenarios
from lerobot_roborecover.platforms import platform_named, platform_names
from lerobot_roborecover.platforms.check import CheckRequest, check_platform
from lerobot_roborecover.platforms.simulator import iter_steps
from lerobot_roborecover.platforms.versions import installed
from lerobot_roborecover.scenario import Reset

EXAMPLE = Path(__file__).parents[2] / "examples" / "maniskill"
PACKAGE = EXAMPLE / "roborecover_maniskill"
STARTERS = {"maniskill": EXAMPLE / "starter", "maniskill_so100": EXAMPLE / "starter_so100"}
LINES = 400

there = importlib.util.find_spec("mani_skill") is not None and "maniskill" in platform_names()
needs_maniskill = pytest.mark.skipif(
    not there or not (os.environ.get("VK_ICD_FILENAMES") or Path("/dev/nvidiactl").exists()),
    reason="no ManiSkill, or no Vulkan device: uv pip install -e examples/maniskill -c constraints.txt, and "
    "export VK_ICD_FILENAMES=$(scripts/vulkan.sh)",
)


def code_lines(source: str) -> int:
    """Lines with code on them: docstrings, comments and blank lines left out."""
    nothing = {tokenize.NL, tokenize.NEWLINE, tokenize.COMMENT, tokenize.INDENT, tokenize.DEDENT}
    lines = {
        line
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type not in nothing | {tokenize.ENDMARKER}
        for line in range(token.start[0], token.end[0] + 1)
    }
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            lines -= set(range(node.lineno, node.end_lineno + 1))
    return len(lines)


def test_it_is_short():
    sources = [path.read_text() for path in PACKAGE.glob("*.py")]
    assert max(len(source.splitlines()) for source in sources) <= LINES
    assert 200 < sum(map(code_lines, sources)) <= LINES


def test_entry_points_name_platforms_that_the_module_has():
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    named = project["entry-points"]["roborecover.platforms"]
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    made = {
        target.id: call.func.id
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple)
        for target, call in zip(node.targets[0].elts, node.value.elts, strict=True)
        if isinstance(call, ast.Call)
    }
    classes = {node.name: ast.unparse(node) for node in tree.body if isinstance(node, ast.ClassDef)}
    assert set(named) == set(STARTERS)
    for name, value in named.items():
        module, _, attribute = value.partition(":")
        assert module == PACKAGE.name
        assert f"'{name}'" in classes[made[attribute]]


@pytest.mark.parametrize("platform", STARTERS)
def test_starter_sets_are_there_and_small(platform):
    rows = pq.read_table(STARTERS[platform] / "meta" / "roborecover" / "scenarios.parquet").to_pylist()
    tasks = {row["name"] for row in rows}
    assert {row["platform"] for row in rows} == {platform}
    assert (len(rows), len(tasks)) >= ((30, 5) if platform == "maniskill" else (6, 2))
    assert {row["split"] for row in rows} == {"train", "test"}
    assert all(row["source"] == "perturbed" for row in rows)
    size = sum(
        path.stat().st_size for folder in STARTERS.values() for path in folder.rglob("*") if path.is_file()
    )
    assert size < 1e6


def test_each_starter_set_has_the_file_that_makes_it():
    for file, platform in (("panda.yaml", "maniskill"), ("so100.yaml", "maniskill_so100")):
        assert yaml.safe_load((EXAMPLE / file).read_text())["platform"] == platform


@needs_maniskill
@pytest.mark.nightly
@pytest.mark.parametrize("name", STARTERS)
def test_horizons_are_those_that_maniskill_registers(name):
    import mani_skill.envs  # noqa: F401 - registers the tasks
    from mani_skill.utils.registration import REGISTERED_ENVS

    for task in platform_named(name).tasks():
        assert task.horizon == REGISTERED_ENVS[task.name].max_episode_steps


@needs_maniskill
@pytest.mark.nightly
@pytest.mark.parametrize("name", STARTERS)
def test_it_keeps_the_contract(name):
    tasks = tuple(platform_named(name).tasks()[:2])
    options = {"obs_type": "pixels_agent_pos", "observation_size": 64}
    checks = list(check_platform(CheckRequest(name, tasks, options, steps=20)))
    assert not [check for check in checks if check.failed], checks
    assert sum("replay in a fresh process" in check.name for check in checks) == 2


@needs_maniskill
@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "task"),
    [("maniskill", "PickCube-v1"), ("maniskill", "StackCube-v1"), ("maniskill_so100", "PickCubeSO100-v1")],
)
def test_a_driver_solves_its_task(name, task):
    platform = platform_named(name)
    simulator = platform.make_simulator(obs_type="state")
    task = platform.task(task)
    simulator.reset(task, Reset(seed=1))
    assert not simulator.succeeded()
    act = platform.experts["scripted"].make(simulator, task, np.random.default_rng(0))
    steps = 0
    while not simulator.succeeded() and steps < 100:
        simulator.step(act(steps))
        steps += 1
    simulator.close()
    assert steps < 100


@needs_maniskill
@pytest.mark.nightly
@pytest.mark.parametrize("name", STARTERS)
def test_starter_scenarios_come_back_as_they_were_recorded(name):
    scenarios = read_scenarios(STARTERS[name])[::6]
    simulator = platform_named(name).make_simulator(obs_type="state")
    recorded = scenarios[0].fingerprint.versions
    same = all(installed(package) == recorded[package] for package in ("mani-skill", "sapien"))
    for scenario in scenarios:
        for _ in iter_steps(simulator, scenario.rollout):
            pass
        bodies = simulator.bodies()
        for body, pose in scenario.fingerprint.bodies.items():
            assert pose.distance_m(bodies[body]) < 0.002, (scenario.id, body)
        assert not simulator.succeeded()
        if same:
            assert simulator.state_sha256() == scenario.fingerprint.state_sha256
    simulator.close()
