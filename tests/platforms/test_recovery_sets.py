"""The open recovery sets: their make-up, what their splits share, and what each scenario says of itself."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

import lerobot_roborecover
from lerobot_roborecover import load_scenarios
from lerobot_roborecover.curation.split_dataset import check_splits
from lerobot_roborecover.datasets import read_scenarios
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.libero import PLATFORM
from lerobot_roborecover.platforms.libero.catalog import LIBERO_HORIZONS
from lerobot_roborecover.scenario import Scenario


@dataclass(frozen=True)
class Wanted:
    """What a set is to have, at least."""

    platform: str
    tests: int
    training: int
    tasks: int
    """In the tests."""
    cells: int
    """With twelve tests or more."""
    size: int
    """Bytes, at most."""
    panel: set[str]
    """Who screened it."""
    versions: set[str]
    suites: dict[str, int] = field(default_factory=dict)
    """Tests of each."""

    @property
    def root(self) -> Path:
        name = f"{self.platform}_recovery"
        return Path(lerobot_roborecover.__file__).parent / "data" / name


SETS = {
    "libero_recovery": Wanted(
        "libero", 200, 800, 34, 9, 12_000_000, {"act", "act_clean", "act_recover", "act_recover_large"},
        {"mujoco", "robosuite", "hf-libero", "libero_assets"}, dict.fromkeys(LIBERO_HORIZONS, 40),
    ),
    "metaworld_recovery": Wanted(
        "metaworld", 300, 600, 15, 9, 6_000_000, {"act_shaken", "act_few", "act_clean", "tdmpc", "diffusion"},
        {"mujoco", "metaworld"},
    ),
}  # fmt: skip


@pytest.fixture(scope="module", params=SETS)
def name(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def wanted(name) -> Wanted:
    return SETS[name]


@pytest.fixture(scope="module")
def scenarios(wanted) -> list[Scenario]:
    return read_scenarios(wanted.root)


def test_the_test_split_can_rank(scenarios, wanted):
    tests = [s for s in scenarios if s.split == "test"]
    assert len(tests) >= wanted.tests
    assert len(scenarios) - len(tests) >= wanted.training
    suites = Counter(s.task.suite for s in tests)
    assert all(suites[suite] >= least for suite, least in wanted.suites.items())
    cells = Counter(s.cell for s in tests)
    assert sum(n >= 12 for n in cells.values()) >= wanted.cells
    assert {s.source.value for s in tests} == {"natural", "perturbed", "human"}
    assert len({s.task.name for s in tests}) >= wanted.tasks


def test_nothing_leaks_from_training_into_tests(wanted):
    report = check_splits(wanted.root, ("trajectory", "record", "start"))
    assert set(report.counts) == {"train", "test"}
    assert not report.leaks


def test_it_is_small_enough_for_the_package(wanted):
    assert sum(f.stat().st_size for f in wanted.root.rglob("*") if f.is_file()) < wanted.size


def test_each_scenario_says_how_it_came_about(scenarios, wanted):
    platform = platform_named(wanted.platform)
    for s in scenarios:
        platform.check_task(s.task)
        assert s.fingerprint.state_sha256
        assert set(s.fingerprint.versions) == wanted.versions
        assert s.provenance["screening"]["policies"].keys() == wanted.panel


@pytest.mark.parametrize("name", ["libero_recovery"], indirect=True)
def test_libero_s_settle_as_libero_does(scenarios):
    for s in scenarios:
        assert s.task.horizon == LIBERO_HORIZONS[s.task.suite]
        assert np.array_equal(s.prefix[:10], np.tile([0, 0, 0, 0, 0, 0, -1.0], (10, 1)))


@pytest.mark.slow
def test_libero_s_is_what_is_evaluated_by_default():
    assert PLATFORM.evaluated("", None) == ("libero_recovery", "test")
    assert len(load_scenarios("libero_recovery", split="test")) == 200
