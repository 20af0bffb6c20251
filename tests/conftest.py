"""Shared test set-up."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

import pytest

import lerobot_roborecover  # noqa: F401 - before numpy: it pins how simulators round

sys.path.insert(0, str(Path(__file__).parent))
os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# No test may reach the network.
os.environ.setdefault("HF_HUB_OFFLINE", "1")


@pytest.fixture(autouse=True)
def lerobot_forgets_configs():
    """LeRobot's parser keeps what a config file said of a policy for the process's next command line."""
    yield
    parser = sys.modules.get("lerobot.configs.parser")
    if parser is not None:
        parser._config_path_args.clear()
        parser._config_yaml_overrides.clear()


@pytest.fixture
def hub():
    """A stand-in of the Hub on the loopback interface."""
    from hub_server import HubServer

    with HubServer() as server:
        yield server


@pytest.fixture
def client(hub, tmp_path):
    """The real Hub client and the command line, in processes that know no other Hub."""
    from hub_client import HubClient

    return HubClient(hub, tmp_path)


@pytest.fixture
def run_lerobot_eval(monkeypatch, tmp_path):
    """Runs `lerobot-eval` in this process, through LeRobot's own parser and loop; returns the output
    folder."""
    from lerobot.scripts import lerobot_eval as script

    import lerobot_roborecover.plugin as plugin

    def run(*args: str, out: str = "out") -> Path:
        folder = tmp_path / out
        argv = ["lerobot-eval", *args, "--policy.device=cpu", f"--output_dir={folder}"]
        monkeypatch.setattr(sys, "argv", plugin.rewrite_env_argument(argv))
        level = logging.getLogger().level
        try:
            script.eval_main()
        finally:
            logging.getLogger().setLevel(level)
        return folder

    return run


def pytest_collection_modifyitems(items):
    """Skips what needs LIBERO's assets where there are none, and says what to set."""
    wanting = [item for item in items if item.get_closest_marker("libero")]
    if not wanting:
        return
    from lerobot_roborecover.simulators import SimulatorError
    from lerobot_roborecover.simulators.libero_assets import find_assets

    try:
        find_assets(download=False)
    except SimulatorError as err:
        for item in wanting:
            item.add_marker(pytest.mark.skip(reason=f"LIBERO's assets: {err}"))
