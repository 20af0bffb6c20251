"""The open LIBERO set: its make-up, what its splits share, and what each scenario says of itself."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import lerobot_roborecover
from lerobot_roborecover import load_scenarios
from lerobot_roborecover.curation.split_dataset import check_splits
from lerobot_roborecover.datasets import read_scenarios
from lerobot_roborecover.platforms.libero import PLATFORM
from lerobot_roborecover.platforms.libero.catalog import LIBERO_HORIZONS
from lerobot_roborecover.scenario import Scenario

FOLDER = Path(lerobot_roborecover.__file__).parent / "data" / "libero_recovery"
PANEL = {"act", "act_clean", "act_recover", "act_recover_large"}


@pytest.fixture(scope="module")
def scenarios() -> list[Scenario]:
    return read_scenarios(FOLDER)


def test_the_test_split_can_rank(scenarios):
    tests = [s for s in scenarios if s.split == "test"]
    assert len(tests) == 200
    suites = Counter(s.task.suite for s in tests)
    assert set(suites) == set(LIBERO_HORIZONS)
    assert min(suites.values()) >= 40
    cells = Counter(s.cell for s in tests)
    assert sum(n >= 12 for n in cells.values()) >= 9
    assert {s.source.value for s in tests} == {"natural", "perturbed", "human"}
    assert len({s.task.name for s in tests}) >= 34


def test_nothing_leaks_from_training_into_tests():
    report = check_splits(FOLDER, ("trajectory", "record", "start"))
    assert set(report.counts) == {"train", "test"}
    assert not report.leaks


def test_it_is_small_enough_for_the_package():
    assert sum(f.stat().st_size for f in FOLDER.rglob("*") if f.is_file()) < 12_000_000


def test_each_scenario_says_how_it_came_about(scenarios):
    for s in scenarios:
        PLATFORM.check_task(s.task)
        assert s.task.horizon == LIBERO_HORIZONS[s.task.suite]
        assert np.array_equal(s.prefix[:10], np.tile([0, 0, 0, 0, 0, 0, -1.0], (10, 1)))
        assert s.fingerprint.state_sha256
        assert set(s.fingerprint.versions) == {"mujoco", "robosuite", "hf-libero", "libero_assets"}
        assert s.provenance["screening"]["policies"].keys() == PANEL


def test_it_is_what_is_evaluated_by_default():
    assert PLATFORM.evaluated("", None) == ("libero_recovery", "test")
    assert len(load_scenarios("libero_recovery", split="test")) == 200
