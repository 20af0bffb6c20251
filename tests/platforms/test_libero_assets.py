"""LIBERO without a simulation: where its assets are found, and what of its files is trusted."""

from __future__ import annotations

import builtins
import io
import os
import pickle
import re
import shutil
import zipfile
from pathlib import Path

import httpx
import pytest

from lerobot_roborecover.platforms.libero import PLATFORM, assets
from lerobot_roborecover.platforms.libero.assets import (
    ASSETS_VARIABLE,
    find_assets,
    missing_asset,
    physics_hash,
)
from lerobot_roborecover.platforms.libero.catalog import libero_instruction, libero_tasks
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.scenario import ScenarioError, Task


def _assets() -> Path | None:
    try:
        return find_assets(download=False)
    except SimulatorError:
        return None


ASSETS_AT_START = _assets()
"""Found before a test hides them."""


def _assets_copy(target: Path, ignore) -> Path:
    shutil.copytree(ASSETS_AT_START, target, ignore=ignore, copy_function=os.symlink)
    return target


def test_unknown_tasks_name_the_nearest():
    name = libero_tasks()["libero_goal"][1]
    good = Task("libero", "libero_goal", name, libero_instruction(name), 300)
    PLATFORM.check_task(good)
    with pytest.raises(ScenarioError, match="no suite 'libero_gaol'; there are libero_spatial"):
        PLATFORM.check_task(Task("libero", "libero_gaol", good.name, good.instruction, 300))
    with pytest.raises(ScenarioError, match="nearest: put_the_bowl_on_the_stove"):
        PLATFORM.check_task(Task("libero", "libero_goal", "put_the_bowl_on_the_stov", good.instruction, 300))
    with pytest.raises(ScenarioError, match="it is a task of libero_goal"):
        PLATFORM.check_task(Task("libero", "libero_10", good.name, good.instruction, 300))
    assert (
        libero_instruction(libero_tasks()["libero_10"][2]) == "turn on the stove and put the moka pot on it"
    )


@pytest.fixture
def nowhere(monkeypatch, tmp_path):
    """A machine without LIBERO's assets, on which reading standard input fails."""
    for variable in (ASSETS_VARIABLE, "LIBERO_CONFIG_PATH"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr(builtins, "input", lambda *_: pytest.fail("asked on standard input"))
    return tmp_path


def test_missing_assets_are_one_clear_error(nowhere, monkeypatch):
    from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator

    with pytest.raises(
        SimulatorError, match=rf"HF_HUB_OFFLINE is set.*--env.assets_dir or \${ASSETS_VARIABLE}"
    ):
        LiberoSimulator()
    with pytest.raises(SimulatorError, match=r"assets_dir names .*no such folder"):
        find_assets(str(nowhere / "absent"))
    monkeypatch.setenv(ASSETS_VARIABLE, str(nowhere))
    with pytest.raises(SimulatorError, match=rf"\${ASSETS_VARIABLE} names .*not a complete"):
        find_assets()


@pytest.mark.libero
def test_half_a_download_is_not_complete(nowhere):
    assets = _assets_copy(
        nowhere / "assets", lambda _folder, names: [n for n in names if n == "butter_vis.msh"]
    )
    assert missing_asset(assets) == "no stable_hope_objects/butter/visual/butter_vis.msh"
    config = nowhere / ".libero" / "config.yaml"
    config.parent.mkdir()
    config.write_text(f"assets: {assets}\n")
    with pytest.raises(SimulatorError, match=r"butter_vis\.msh"):
        find_assets()


@pytest.mark.libero
def test_liberos_own_configuration_is_honoured(nowhere):
    assets = _assets_copy(nowhere / "assets", lambda *_: [])
    config = nowhere / ".libero" / "config.yaml"
    config.parent.mkdir()
    config.write_text(f"assets: {assets}\nbenchmark_root: elsewhere\n")
    assert find_assets() == assets


@pytest.mark.libero
def test_asset_hash_follows_physics_not_looks(tmp_path):
    looks = shutil.ignore_patterns("*.png", "*.msh")
    shutil.copytree(ASSETS_AT_START, tmp_path / "assets", ignore=looks)
    assert physics_hash(tmp_path / "assets") == physics_hash(ASSETS_AT_START)
    model = tmp_path / "assets/stable_hope_objects/butter/butter.xml"
    model.chmod(0o644)
    text = model.read_text()
    model.write_text(text.replace('rgba="', 'rgba="0.5 '))
    assert physics_hash(tmp_path / "assets") == physics_hash(ASSETS_AT_START)
    changed = text.replace('density="', 'density="1', 1)
    assert changed != text
    collision = text.replace('group="0"', 'group="0" margin="0.001"', 1)
    assert collision != text
    model.write_text(collision)
    assert physics_hash(tmp_path / "assets") != physics_hash(ASSETS_AT_START)


def test_init_states_run_no_code(tmp_path, monkeypatch):
    from lerobot_roborecover.platforms.libero import init_states

    class Payload:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "ran"),)

    folder = tmp_path / "init_files" / "libero_goal"
    folder.mkdir(parents=True)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(Payload(), protocol=2))
    (folder / "bad.pruned_init").write_bytes(buffer.getvalue())
    monkeypatch.setattr(init_states, "package_root", lambda: tmp_path)
    with pytest.raises(SimulatorError, match="not part of a numpy array"):
        init_states.read_init_states("libero_goal", "bad")
    assert not (tmp_path / "ran").exists()


def test_a_hub_that_does_not_answer_is_a_reason(tmp_path, monkeypatch):
    def unreachable(*_, **__):
        raise httpx.ConnectError("Name or service not known")

    monkeypatch.setattr("huggingface_hub.snapshot_download", unreachable)
    assert "failed (Name or service not known)" in assets._download(tmp_path)


def test_a_download_names_its_commit(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda repo_id, **options: asked.append(options))
    assert "incomplete" in assets._download(tmp_path)
    assert re.fullmatch("[0-9a-f]{40}", asked[0]["revision"])
    assert asked[0]["local_dir"] == tmp_path
