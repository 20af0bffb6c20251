"""What GitHub runs for the project: pinned, with few rights, and the same commands as people's."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def jobs():
    for path in WORKFLOWS:
        for name, job in yaml.safe_load(path.read_text())["jobs"].items():
            yield pytest.param(job, id=f"{path.stem}-{name}")


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda p: p.stem)
def test_a_workflow_grants_nothing_by_itself(path):
    workflow = yaml.safe_load(path.read_text())
    assert workflow["permissions"] == {}
    assert "pull_request_target" not in workflow[True], "YAML reads `on` as true"


@pytest.mark.parametrize("job", jobs())
def test_a_job_runs_what_is_pinned_and_there(job):
    assert job["timeout-minutes"]
    assert "write" not in {v for k, v in job["permissions"].items() if k not in ("id-token", "pages")}
    for step in job["steps"]:
        if "uses" in step:
            assert re.fullmatch(r"[\w.-]+/[\w.-]+@[0-9a-f]{40}", step["uses"])
            checkout = step["uses"].startswith("actions/checkout@")
            assert not checkout or step["with"]["persist-credentials"] is False
        for script in re.findall(r"scripts/[\w.-]+", step.get("run", "")):
            assert (ROOT / script).stat().st_mode & 0o100, script


def test_one_version_of_every_tool():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    (ruff,) = (repo["rev"].removeprefix("v") for repo in hooks if "ruff" in repo["repo"])
    assert f"ruff=={ruff}" in EXTRAS["lint"]
    assert f"ruff=={ruff}" in EXTRAS["docs"], "which lays signatures out"


def test_an_extra_can_be_had_alone():
    done = subprocess.run(
        [sys.executable, ROOT / "scripts" / "extra.py", "lint", "workflows"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines() == EXTRAS["lint"] + EXTRAS["workflows"]
    refused = subprocess.run([sys.executable, ROOT / "scripts" / "extra.py", "nonsense"], capture_output=True)
    assert refused.returncode == 1
    assert b"no extra 'nonsense'" in refused.stderr


@pytest.mark.parametrize(
    "form", sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("[!c]*.yml")), ids=lambda p: p.stem
)
def test_issue_forms(form):
    found = yaml.safe_load(form.read_text())
    assert {"name", "description", "body"} <= set(found)
    ids = [item["id"] for item in found["body"]]
    assert len(set(ids)) == len(ids)


@pytest.mark.parametrize("tool", ["actionlint", "zizmor"])
def test_linters_of_workflows_find_nothing(tool):
    if shutil.which(tool) is None:
        pytest.skip(f"no {tool}: scripts/lint.sh installs and runs it")
    arguments = ["--offline", "--persona", "auditor", ".github"] if tool == "zizmor" else []
    done = subprocess.run([tool, *arguments], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_dependabot_looks_after_python_but_for_what_decides_scores():
    updates = yaml.safe_load((ROOT / ".github" / "dependabot.yml").read_text())["updates"]
    (python,) = (u for u in updates if u["package-ecosystem"] == "pip")
    assert python["directories"] == ["/", "/scripts"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = [*project["dependencies"], *(r for e in ("libero", "robotwin", "gym") for r in EXTRAS[e])]
    decisive = {re.split(r"[\[=]", r)[0] for r in pinned if "==" in r}
    assert {entry["dependency-name"] for entry in python["ignore"]} == decisive
    by_hand = [f"version-update:semver-{part}" for part in ("major", "minor", "patch")]
    assert all(entry["update-types"] == by_hand for entry in python["ignore"]), (
        "security updates are proposed"
    )
