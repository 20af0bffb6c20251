"""What importing costs, and what stays out of simulator workers."""

from __future__ import annotations

import subprocess
import sys

HEAVY = ("lerobot", "torch", "mujoco", "metaworld", "libero", "robosuite", "datasets", "huggingface_hub")


def modules_after(code: str) -> set[str]:
    out = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys; print(' '.join(sys.modules))"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return {name.partition(".")[0] for name in out.stdout.split()}


def test_importing_the_package_is_light():
    loaded = modules_after("import lerobot_roborecover")
    assert not loaded & {*HEAVY, "pyarrow", "matplotlib", "scipy"}


def test_a_worker_needs_neither_lerobot_nor_torch():
    code = (
        "from lerobot_roborecover.workers import slot_server\n"
        "from lerobot_roborecover.workers import jobs, worker\n"
        "from lerobot_roborecover.workers.messages import SlotConfig\n"
        "slot_server.SlotServer(SlotConfig('fake'))"
    )
    assert not modules_after(code) & set(HEAVY)


def test_a_running_metaworld_worker_loads_neither_lerobot_nor_torch():
    code = (
        "from lerobot_roborecover.workers.slot_server import SlotServer\n"
        "from lerobot_roborecover.workers.messages import EpisodeSpec, SlotConfig\n"
        "from lerobot_roborecover import load_scenarios\n"
        "server = SlotServer(SlotConfig('metaworld', {'obs_type': 'state'}))\n"
        "server.answer('reset', EpisodeSpec(load_scenarios('metaworld_starter')[0], 'recovery', 0, True))"
    )
    assert not modules_after(code) & {"lerobot", "torch"}


def test_reading_scenarios_needs_no_simulator():
    assert not modules_after("from lerobot_roborecover import load_scenarios") & {
        "lerobot",
        "torch",
        "mujoco",
    }


def test_the_version_has_one_place():
    import tomllib
    from pathlib import Path

    import yaml

    from lerobot_roborecover import __version__

    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text())
    assert "version" not in project["project"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {
        "attr": "lerobot_roborecover._version.__version__"
    }
    assert yaml.safe_load((root / "CITATION.cff").read_text())["version"] == __version__
