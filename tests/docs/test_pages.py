"""The documentation's code: every command is one, every option exists, and Python runs or says why not."""

from __future__ import annotations

import ast
import importlib
import json
import os
import re

import pytest

from lerobot_roborecover.cli.tree import find_call
from tests.support.doc_blocks import PAGES, ROOT, Block, all_blocks, commands

OPTIONS = json.loads((ROOT / "tests" / "cli" / "options.json").read_text())
POLICY = str(ROOT / "lerobot_roborecover" / "data" / "metaworld_act")
STAND_INS = {
    "<Meta-World checkpoint>": POLICY,
    "outputs/train/act/checkpoints/last/pretrained_model": POLICY,
    "cell=Approach-*|Place-*": "cell=Place-*",
    "trials=5": 'trials=1, env={"obs_type": "state"}',
}
"""What a reader puts into a page, by what the page says."""
LEROBOTS = {
    "--env", "--output_dir", "--config_path", "--seed", "--job_name", "--rename_map",
    *(f"--{name}" for name in ("engine", "videos", "limit-seconds", "sequential", "shard", "retry")),
}  # fmt: skip
"""LeRobot's own of `lerobot-eval`, and the short names that `roborecover eval` adds."""
NESTED = ("--env.", "--policy.", "--eval.", "--runner.", "--check.", "--robot.", "--teleop.")
"""Beginnings of options that LeRobot's parser reads, which refuses unknown ones itself."""
NAVIGATION = set(re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text()))
PYTHON = all_blocks("python")
RUN_ELSEWHERE = ("CONTRIBUTING.md", "docs/tutorials/")
"""In `tests/test_contributing.py` and `tests/docs/test_tutorials.py`."""


def named(block: Block) -> str:
    return block.name


def calls():
    for block in all_blocks("bash"):
        for words in commands(block.code, "roborecover"):
            yield pytest.param(words, id=f"{block.name}-{words[0] if words else ''}")


@pytest.mark.parametrize("words", calls())
def test_a_command_and_its_options_exist(words):
    if words[0].startswith("-"):
        return
    call = find_call(words)
    assert call is not None
    assert not call.note, "pages say the new names"
    command, rest = call.name, call.rest
    ours = OPTIONS["ours"].get(command)
    known = set(OPTIONS["lerobots"][command]) if ours is None else set(ours)
    if ours is None:
        known |= LEROBOTS
    for word in rest:
        option = word.split("=")[0]
        if option.startswith("--"):
            nested = (ours is None or command == "curate collect") and option.startswith(NESTED)
            assert option in known or nested, f"{option}: no option of roborecover {command}"


@pytest.mark.slow
@pytest.mark.parametrize("block", PYTHON, ids=named)
def test_python_is_python_and_its_imports_are_there(block):
    tree = ast.parse(block.code, block.name)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lerobot_roborecover"):
            module = importlib.import_module(node.module)
            for alias in node.names:
                assert hasattr(module, alias.name), f"{node.module} has no {alias.name}"


@pytest.mark.lerobot
@pytest.mark.metaworld
@pytest.mark.slow
@pytest.mark.parametrize(
    "block",
    [
        pytest.param(b, marks=[pytest.mark.nightly] if b.page == "README.md" else [])  # half a minute
        for b in PYTHON
        if not b.why_not_run and not b.page.startswith(RUN_ELSEWHERE)
    ],
    ids=named,
)
def test_python_runs(block, tmp_path, monkeypatch):
    import numpy

    from lerobot_roborecover import load_scenarios
    from lerobot_roborecover.platforms import make_simulator

    monkeypatch.chdir(tmp_path)
    scenarios = sorted(load_scenarios("metaworld_starter"), key=lambda s: len(s.prefix))[:2]
    names = {"scenarios": scenarios, "scenario": scenarios[0], "numpy": numpy}
    code = block.code
    for says, means in STAND_INS.items():
        code = code.replace(says, means)
    simulator = make_simulator("metaworld", obs_type="state")
    try:
        exec(compile(code, block.name, "exec"), {**names, "simulator": simulator})
    finally:
        simulator.close()


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_a_page_is_in_the_site_and_its_links_lead_somewhere(page):
    if page.parent not in (ROOT, ROOT / "docs" / "log"):
        assert str(page.relative_to(ROOT / "docs")) in NAVIGATION
    for target in re.findall(r"(?<!`)\]\(([^)\s#:]+)(?:#[^)]*)?\)", page.read_text()):
        assert (page.parent / target).exists(), target


def test_reasons_are_given_for_what_is_not_run():
    unrun = [b for b in [*PYTHON, *all_blocks("bash")] if b.why_not_run]
    assert unrun
    assert all(len(b.why_not_run) > 10 for b in unrun)


@pytest.mark.parametrize("command", ["scripts/demo.sh", "scripts/test.sh"])
def test_the_readme_has_the_commands_that_need_nothing_set_up(command):
    begins = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert any(line.split(" ")[0] == command for line in begins)
    assert os.access(ROOT / command, os.X_OK)


def test_pages_that_the_code_names_are_there():
    files = [
        f for folder in ("lerobot_roborecover", "recipes", "scripts") for f in (ROOT / folder).rglob("*.py")
    ]
    named = {
        (f, page) for f in files for page in re.findall(r"\bdocs/[\w/]+\.md", f.read_text(encoding="utf-8"))
    }
    assert len(named) > 20
    assert [(str(f), page) for f, page in named if not (ROOT / page).is_file()] == []
