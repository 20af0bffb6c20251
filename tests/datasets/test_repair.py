"""LeRobot's dataset tools on our datasets, and what repair makes of the result."""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.datasets.files import PENDING
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.repair import repair
from lerobot_roborecover.datasets.trajectories import read_exact, read_trajectories
from lerobot_roborecover.datasets.trajectory_write import write_trajectories
from lerobot_roborecover.datasets.write import write_episodes
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.text import pluralize
from tests.datasets.test_trajectories import trajectory
from tests.support.factories import fake_scenario
from tests.support.release_files import files_of
from tests.support.scenario_files import bits

pytestmark = [pytest.mark.lerobot, pytest.mark.slow]


def camera():
    return make_simulator("fake", obs_type="pixels_agent_pos", observation_size=64)


def scenario_set(root, rows):
    return write_episodes(root, [fake_scenario(i, steps=4 + i) for i in rows], camera, license="mit")


def edit(operation: str, out, *arguments: str) -> None:
    """`lerobot-edit-dataset` as a user runs it, in this process."""
    from lerobot.scripts.lerobot_edit_dataset import main as lerobot_edit_dataset

    options = [f"--operation.type={operation}", f"--new_repo_id=lab/{out.name}", f"--new_root={out}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["lerobot-edit-dataset", *options, *arguments])
        lerobot_edit_dataset()


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """Two scenario datasets and what LeRobot's tools make of them."""
    root = tmp_path_factory.mktemp("sets")
    a, b = scenario_set(root / "a", range(4)), scenario_set(root / "b", range(4, 7))
    names, roots = "--operation.repo_ids=['lab/b', 'lab/a']", f"--operation.roots=['{b}', '{a}']"
    edit("merge", root / "merged", names, roots)
    one = ("--repo_id=lab/a", f"--root={a}")
    edit("delete_episodes", root / "deleted", *one, "--operation.episode_indices=[1, 2]")
    edit("split", root / "split", *one, '--operation.splits={"x": [0, 3], "y": [1, 2]}')
    return root


def check(root, expected):
    """The repaired dataset holds these scenarios, bit for bit, and every frame names its own."""
    found = load_scenarios(root)
    assert [bits(s) for s in found] == [bits(fake_scenario(i, steps=4 + i)) for i in expected]
    for row, (actions, index) in enumerate(read_exact(root)):
        assert actions.tobytes() == found[row].prefix.tobytes()
        assert set(index) == {row}
    assert found.manifest["license"] == "mit"
    assert [f.sha256 for f in FrameStore(root).values()] == [s.sha256() for s in found]


@pytest.mark.parametrize(
    ("made", "names", "expected"),
    [
        ("merged", ["a", "b"], [4, 5, 6, 0, 1, 2, 3]),
        ("deleted", ["a"], [0, 3]),
        ("split/x", ["a"], [0, 3]),
        ("split/y", ["a", "b"], [1, 2]),
    ],
)
def test_tools_of_lerobot_lose_our_metadata_and_repair_brings_it_back(
    sources, tmp_path, capsys, made, names, expected
):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "set"
    shutil.copytree(sources / made, root)
    with pytest.raises(ScenarioError):
        load_scenarios(root)
    arguments = ["repair", str(root), "--from", *(str(sources / n) for n in names)]
    before = files_of(root)
    assert main([*arguments, "--dry-run"]) == 0
    assert files_of(root) == before
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert f"{len(expected)} episodes found again in {pluralize(len(names), 'source')}" in said
    check(root, expected)
    dataset = LeRobotDataset("lab/x", root=root)
    assert dataset.num_episodes == len(expected)
    assert dataset[len(dataset) - 1]["observation.image"].shape == (3, 64, 64)
    before = files_of(root)
    assert main(arguments) == 0
    assert "0 frames renumbered" in capsys.readouterr().out
    assert files_of(root) == before


def test_a_repair_that_is_cut_short_is_finished_by_the_next_command(sources, tmp_path, monkeypatch):
    """Data and metadata change at one moment: before it nothing has, after it a reader finds all."""
    root, replace_file = tmp_path / "set", os.replace
    shutil.copytree(sources / "merged", root)
    before, left = files_of(root), 0

    def cut_short(source, target):
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        replace_file(source, target)

    for operations in range(50):
        left = operations
        with monkeypatch.context() as patched:
            patched.setattr(os, "replace", cut_short)
            try:
                repair(root, [str(sources / "a"), str(sources / "b")])
                break
            except KeyboardInterrupt:
                pass
        if not (root / PENDING).exists():
            assert files_of(root) == before
        else:
            check(root, [4, 5, 6, 0, 1, 2, 3])
            shutil.rmtree(root)
            shutil.copytree(sources / "merged", root)
    assert operations > 4


def test_an_episode_of_no_source_is_refused_and_nothing_is_changed(sources, tmp_path):
    root = tmp_path / "set"
    shutil.copytree(sources / "merged", root)
    before = files_of(root)
    with pytest.raises(ScenarioError, match=r"episode 0 \(8 actions\): 0 entries.*every dataset"):
        repair(root, [str(sources / "a")])
    assert files_of(root) == before


def test_a_scenario_twice_is_refused(sources, tmp_path):
    from lerobot.datasets.dataset_tools import merge_datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    one = LeRobotDataset("lab/a", root=sources / "a")
    merge_datasets([one, one], "lab/twice", output_dir=tmp_path / "twice")
    with pytest.raises(ScenarioError, match="has 2 episodes"):
        repair(tmp_path / "twice", [str(sources / "a")])


@pytest.mark.nightly
def test_trajectory_datasets_are_repaired_too(tmp_path):
    from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    labels = [0, 0, 1, 1, 1]
    a = write_trajectories(
        tmp_path / "a", "monitor", [trajectory(i, labels=labels) for i in range(4)], fps=20
    )
    b = write_trajectories(
        tmp_path / "b", "monitor", [trajectory(i, labels=labels) for i in (5, 2, 3)], fps=20
    )
    one, two = LeRobotDataset("lab/a", root=a), LeRobotDataset("lab/b", root=b)
    delete_episodes(one, [0, 2, 3], output_dir=tmp_path / "less", repo_id="lab/less")
    less = LeRobotDataset("lab/less", root=tmp_path / "less")
    merge_datasets([less, two], "lab/merged", output_dir=tmp_path / "merged")
    done = repair(tmp_path / "merged", [str(a), str(b)])
    assert "4 trajectories of 3 scenarios" in "\n".join(done.lines)
    found = read_trajectories(tmp_path / "merged")
    made = [trajectory(i) for i in (1, 5, 2, 3)]
    assert [found.scenarios[r.scenario_index].id for r in found.rows] == [t.scenario.id for t in made]
    assert [r.trial for r in found.rows] == [t.trial for t in made]
    for actions, t in zip(found.actions(), made, strict=True):
        np.testing.assert_array_equal(actions, t.actions)
    assert [set(index) for _, index in read_exact(tmp_path / "merged")] == [{0}, {1}, {2}, {2}]
    assert sum(found.manifest["counts"]["labels"].values()) == 20
    assert replace(found.rows[2], scenario_index=0) == replace(read_trajectories(b).rows[1], scenario_index=0)
