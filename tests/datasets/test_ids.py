"""Ids as long as the paper's release has them go everywhere, and no file name made of one is too long."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.curation.candidates import Candidate
from lerobot_roborecover.curation.collect.record import record_path
from lerobot_roborecover.datasets import load_scenarios, write_scenarios
from lerobot_roborecover.datasets.release.convert import read_release
from lerobot_roborecover.datasets.release.export import export_release
from lerobot_roborecover.datasets.release.tables import check_row
from lerobot_roborecover.evaluation.videos import VideoRecorder
from lerobot_roborecover.evaluation.work_items import WorkItem
from lerobot_roborecover.platforms.libero.catalog import LIBERO_SUITES, libero_tasks
from lerobot_roborecover.scenario import (
    MAX_ID_CHARS,
    DeviationType,
    Outcome,
    ScenarioError,
    Source,
    Stage,
    is_id,
)
from lerobot_roborecover.utils.atomic_io import atomic_write
from tests.support.factories import fake_scenario
from tests.support.release_files import libero_record, read_rows, real_id, write_release


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("names")


def named(scenario, name):
    object.__setattr__(scenario, "id", name)
    return scenario


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    suite=st.sampled_from(LIBERO_SUITES),
    task=st.integers(0, 9),
    episode=st.integers(0, 49),
    cell=st.tuples(st.sampled_from(list(Stage)), st.sampled_from(list(DeviationType))),
    step=st.integers(0, 999),
)
def test_ids_of_the_real_form_are_ids_of_everything(folder, suite, task, episode, cell, step):
    name = real_id(suite, libero_tasks()[suite][task], episode, cell, step)
    assert is_id(name)
    assert Candidate(id=name, source=Source.NATURAL).id == name
    cells = {
        "sample_id": name, "path": f"libero/test/{name}.json", "sha256": "0" * 64, "original_sha256": "",
        "actions": "5", "replay_prefix_steps": "5",
    }  # fmt: skip
    assert check_row(1, cells).sample_id == name
    write_scenarios(folder / "set", [named(fake_scenario(0), name)])
    assert load_scenarios(folder / "set")[0].id == name


@pytest.mark.parametrize("length", [129, 146, MAX_ID_CHARS])
def test_a_long_id_is_a_file_name_with_all_that_is_added_to_it(tmp_path, length):
    name = "x" * length
    scenario = named(fake_scenario(0), name)
    videos = VideoRecorder(tmp_path / "films", 9, "all", [name])
    frame = np.zeros((16, 16, 3), np.uint8)
    for outcome in Outcome:
        unit = WorkItem(scenario, 2**32 - 1)
        videos.finish(videos.begin(unit, frame, 10.0), unit, outcome)
    assert len(videos.kept) == len(Outcome)
    for path in (
        record_path(tmp_path, name),
        tmp_path / f"{name}.png",
        tmp_path / f"{name}-{scenario.sha256()[:8]}.jpg",
        # LeRobot's own folder of a scenario's videos (lerobot_eval.py), with the longest group of ours.
        tmp_path / f"Approach-Stage Rollback_{name}" / "eval_episode_0.mp4",
    ):
        atomic_write(path, b"whole")
        assert path.read_bytes() == b"whole"


def test_an_id_that_no_file_can_carry_is_refused_with_its_length():
    for make in (
        lambda: replace(fake_scenario(0), id="x" * 201),
        lambda: Candidate(id="x" * 201, source=Source.NATURAL),
    ):
        with pytest.raises(ScenarioError, match=r"\(201 characters\) is not 1 to 200 letters"):
            make()


def test_a_release_of_mug_tasks_converts_and_comes_back(tmp_path):
    records = [libero_record(2 * i + 1) for i in range(3)]
    for record, task in zip(records, (4, 6, 4), strict=True):
        record["task_id"] = task
    ids = [
        real_id("libero_10", libero_tasks()["libero_10"][r["task_id"]], 40 + i, ("Move", "Wrong Pose"), 400)
        for i, r in enumerate(records)
    ]
    assert all(129 <= len(i) <= 146 for i in ids)
    root = write_release(tmp_path / "release", {"libero": {"test": records}}, ids=ids)
    result = read_release(root, "libero")
    assert not result.failures
    assert (
        [s.id for s in result.scenarios] == ids == [r["sample_id"] for r in read_rows(root, "libero", "test")]
    )
    assert not export_release(result.scenarios, tmp_path / "back")
