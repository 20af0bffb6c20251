"""The open recovery sets: their make-up, what their splits share, and what each scenario says of itself."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

import lerobot_roborecover
from lerobot_roborecover import load_scenarios
from lerobot_roborecover.curation.split_dataset import check_splits
from lerobot_roborecover.datasets import read_scenarios
from lerobot_roborecover.datasets.schema import FOLDER, SCENARIOS_FILE
from lerobot_roborecover.datasets.write import file_sha256
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
    unscreened: int = 0


_LIBERO_VERSIONS = {"mujoco", "robosuite", "hf-libero", "libero_assets"}
SETS = {
    "libero_recovery": Wanted(
        "libero", 235, 706, 39, 11, 12_000_000,
        {"act_recover", "tdmpc_recover", "diffusion_recover", "diffusion_few"},
        _LIBERO_VERSIONS, dict.fromkeys(LIBERO_HORIZONS, 40), 201,
    ),
    "libero_recovery_0": Wanted(
        "libero", 200, 800, 34, 9, 12_000_000, {"act", "act_clean", "act_recover", "act_recover_large"},
        _LIBERO_VERSIONS, dict.fromkeys(LIBERO_HORIZONS, 40),
    ),
    "metaworld_recovery": Wanted(
        "metaworld", 300, 600, 15, 9, 6_000_000, {"act_shaken", "act_few", "act_clean", "tdmpc", "diffusion"},
        {"mujoco", "metaworld"},
    ),
}  # fmt: skip


FROZEN = "4362833200d0aee6b181718a502191a28748c3edeb609d4e8a8a1e5735d81614"
"""SHA-256 of the scenarios of `libero_recovery` 1.0. Another choice gets another name."""


@pytest.fixture(scope="module", params=SETS)
def name(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def wanted(name) -> Wanted:
    return SETS[name]


@pytest.fixture(scope="module")
def root(name) -> Path:
    return Path(lerobot_roborecover.__file__).parent / "data" / name


@pytest.fixture(scope="module")
def scenarios(root) -> list[Scenario]:
    return read_scenarios(root)


def test_the_test_split_can_rank(scenarios, wanted):
    tests = [s for s in scenarios if s.split == "test"]
    splits = Counter(s.split for s in scenarios)
    assert splits["test"] >= wanted.tests
    assert splits["train"] >= wanted.training
    assert splits["unscreened"] >= wanted.unscreened
    suites = Counter(s.task.suite for s in tests)
    assert all(suites[suite] >= least for suite, least in wanted.suites.items())
    cells = Counter(s.cell for s in tests)
    assert sum(n >= 12 for n in cells.values()) >= wanted.cells
    assert {s.source.value for s in tests} == {"natural", "perturbed", "human"}
    assert len({s.task.name for s in tests}) >= wanted.tasks


def test_nothing_leaks_from_training_into_tests(root, wanted):
    report = check_splits(root, ("trajectory", "record", "start"))
    assert set(report.counts) == {"train", "test"} | ({"unscreened"} if wanted.unscreened else set())
    assert not report.leaks


def test_it_is_small_enough_for_the_package(root, wanted):
    assert sum(f.stat().st_size for f in root.rglob("*") if f.is_file()) < wanted.size


def test_each_scenario_says_how_it_came_about(scenarios, wanted):
    platform = platform_named(wanted.platform)
    for s in scenarios:
        platform.check_task(s.task)
        assert s.fingerprint.state_sha256
        assert set(s.fingerprint.versions) == wanted.versions
        assert s.provenance["screening"]["policies"].keys() == wanted.panel


@pytest.mark.parametrize("name", ["libero_recovery"], indirect=True)
def test_libero_s_are_frozen(root):
    assert file_sha256(root / FOLDER / SCENARIOS_FILE) == FROZEN


@pytest.mark.parametrize("name", ["libero_recovery"], indirect=True)
def test_no_two_recovery_points_of_a_task_are_within_5_mm(scenarios):
    """In at least one body; of all splits."""
    points = defaultdict(list)
    for s in scenarios:
        bodies = s.fingerprint.bodies
        points[s.task.suite, s.task.name].append([bodies[name].position_m for name in sorted(bodies)])
    for found in points.values():
        a, b = np.triu_indices(len(found), 1)
        positions = np.array(found)
        assert np.linalg.norm(positions[a] - positions[b], axis=-1).max(axis=-1).min() > 0.005


@pytest.mark.parametrize("name", ["libero_recovery", "libero_recovery_0"], indirect=True)
def test_libero_s_settle_as_libero_does(scenarios):
    for s in scenarios:
        assert s.task.horizon == LIBERO_HORIZONS[s.task.suite]
        assert np.array_equal(s.prefix[:10], np.tile([0, 0, 0, 0, 0, 0, -1.0], (10, 1)))


@pytest.mark.slow
def test_libero_s_is_what_is_evaluated_by_default():
    assert PLATFORM.evaluated("", None) == ("libero_recovery", "test")
    assert len(load_scenarios("libero_recovery", split="test")) == 235
