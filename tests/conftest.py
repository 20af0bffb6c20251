"""Shared test set-up."""

from __future__ import annotations

import functools
import importlib.util
import logging
import os
import sys
from collections import Counter

import pytest
from hypothesis import HealthCheck, settings

import lerobot_roborecover  # noqa: F401 - before numpy: it pins how simulators round

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# No test may reach the network.
os.environ.setdefault("HF_HUB_OFFLINE", "1")
# No example is expected within a time: other work on the machine makes anything slow.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")


@pytest.fixture(autouse=True)
def draccus_reads_a_docstring_once():
    """Draccus reads the help of some 900 options from source at each parse; tests parse hundreds of times."""
    module = sys.modules.get("draccus.wrappers.docstring")
    if module is not None and not hasattr(module.get_attribute_docstring, "cache_info"):
        module.get_attribute_docstring = functools.cache(module.get_attribute_docstring)


@pytest.fixture(autouse=True)
def lerobot_forgets_configs():
    """LeRobot's parser keeps what a config file said of a policy for the process's next command line."""
    yield
    parser = sys.modules.get("lerobot.configs.parser")
    if parser is not None:
        parser._config_path_args.clear()
        parser._config_yaml_overrides.clear()


@pytest.fixture(autouse=True)
def logging_forgets_streams():
    """LeRobot's `init_logging` has the root logger write to the streams of the test that called it, which
    pytest closes at its end: whatever logs later would print a logging error."""
    root = logging.getLogger()
    before, level = list(root.handlers), root.level
    yield
    root.setLevel(level)
    for handler in list(root.handlers):
        if type(handler) in (logging.StreamHandler, logging.FileHandler) and handler not in before:
            root.removeHandler(handler)
            handler.close()


@pytest.fixture
def hub():
    """A stand-in of the Hub on the loopback interface."""
    from tests.support.hub_server import HubServer

    with HubServer() as server:
        yield server


@pytest.fixture
def client(hub, tmp_path, tmp_path_factory):
    """The real Hub client and the command line, in processes that know no other Hub."""
    from tests.support.hub_client import HubClient

    return HubClient(hub, tmp_path, tmp_path_factory.mktemp("client"))


@pytest.fixture(scope="session")
def vulkan():
    """A Vulkan device that SAPIEN renders on."""
    from tests.support.robotwin_checkouts import can_render

    if not can_render():
        pytest.skip("SAPIEN finds no Vulkan device: scripts/vulkan.sh, and VK_ICD_FILENAMES as it says")


@pytest.fixture(scope="session")
def no_vulkan():
    """A machine on which SAPIEN cannot render."""
    from tests.support.robotwin_checkouts import can_render

    if can_render():
        pytest.skip("a Vulkan device is there: this tests what is said where there is none")


@pytest.fixture
def run_lerobot_eval(tmp_path):
    """Runs `lerobot-eval` in this process, through LeRobot's own parser and loop; returns the output
    folder."""
    from tests.support.stock_eval import lerobot_eval

    return lambda *args, out="out": lerobot_eval(tmp_path / out, *args)


HEAVY = ("slow", "nightly", "lerobot", "libero", "metaworld", "robotwin", "ray", "browser")
"""Marks of what `--quick` leaves out."""


PACKAGES = {"robotwin": ("sapien", "robotwin"), "ray": ("ray", "ray"), "browser": ("playwright", "test")}
"""By mark: the package that it needs, and the extra that has it. Nothing is imported to find out."""


def pytest_addoption(parser):
    """Which of three sets runs: the default one, `--quick`, or with `--nightly` everything."""
    parser.addoption("--nightly", action="store_true", help="run the tests marked nightly, too")
    parser.addoption("--quick", action="store_true", help=f"leave out what is marked {', '.join(HEAVY)}")


def pytest_collection_modifyitems(config, items):
    """Leaves out what was not asked for, and skips what needs a package or LIBERO's assets where there are
    none, and says what to do."""
    if config.getoption("--quick") and "torch" in sys.modules:
        raise pytest.UsageError("a test module imports torch: import it in the tests, and mark them lerobot")
    unwanted = () if config.getoption("--nightly") else ("nightly",)
    if config.getoption("--quick"):
        unwanted = HEAVY
    left_out = [item for item in items if any(map(item.get_closest_marker, unwanted))]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in set(left_out)]
    for mark, (module, extra) in PACKAGES.items():
        if importlib.util.find_spec(module) is None:
            _skip(items, mark, f"no {module}: pip install 'lerobot_env_roborecover[{extra}]'")
    if not any(item.get_closest_marker("libero") for item in items):
        return
    from lerobot_roborecover.platforms import SimulatorError
    from lerobot_roborecover.platforms.libero.assets import find_assets

    try:
        find_assets(download=False)
    except SimulatorError as err:
        _skip(items, "libero", f"no LIBERO: {err}")


def _skip(items: list, mark: str, reason: str) -> None:
    for item in items:
        if item.get_closest_marker(mark):
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(autouse=True)
def marked_as_what_it_needs(request):
    """The quick set stays quick: nothing in it imports LeRobot, or whatever else takes seconds to start."""
    before = "torch" in sys.modules
    yield
    if request.config.getoption("--quick") and not before and "torch" in sys.modules:
        pytest.fail("it imports torch: mark it lerobot, which keeps it out of the quick set")


def pytest_terminal_summary(terminalreporter):
    """What was skipped, each reason once, with what to do about it."""
    reasons = Counter(
        report.longrepr[2].removeprefix("Skipped: ")
        for report in terminalreporter.stats.get("skipped", [])
        if isinstance(report.longrepr, tuple | list)
    )
    if reasons:
        terminalreporter.section("skipped, and what to do about it")
        for reason, count in sorted(reasons.items()):
            terminalreporter.line(f"{count:4} × {reason}")
