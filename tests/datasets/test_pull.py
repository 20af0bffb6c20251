"""`dataset pull`, and whole round trips, against a server on loopback that speaks the Hub's protocol."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lerobot_roborecover.datasets import load_scenarios, read_scenarios
from lerobot_roborecover.datasets.contents import check_file, check_names, list_files
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_dataset, fake_scenario
from tests.support.hub_client import REPO, commit_of
from tests.support.hub_server import Repo
from tests.support.release_files import files_of
from tests.support.scenario_files import bits, png


@pytest.fixture
def local(tmp_path):
    return fake_dataset(tmp_path / "local", 6)


def put(hub, root: Path, **extra: bytes) -> None:
    hub.repos[REPO] = Repo()
    hub.repos[REPO].commit({**files_of(root), **extra})


@pytest.mark.slow
def test_a_pull_that_is_cut_leaves_nothing_and_a_later_one_completes(hub, client, local, tmp_path):
    put(hub, local)
    hub.cut.add("meta/roborecover/scenarios.parquet")
    before = {p.name for p in tmp_path.iterdir()}
    done = client.roborecover("pull", REPO, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert {p.name for p in tmp_path.iterdir()} - {"hf"} == before - {"hf"}
    hub.cut.clear()
    done = client.roborecover("pull", REPO, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert [bits(s) for s in read_scenarios(tmp_path / "out")] == [bits(s) for s in read_scenarios(local)]


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ({"data/model.pkl": b"\x80\x04."}, ["'data/model.pkl'", "run code"]),
        ({"meta/roborecover/x.py": b"import os"}, ["x.py", "run code"]),
        ({"data/file-000.parquet": b"\x80\x04\x95pickle"}, ["data/file-000.parquet", "not a parquet"]),
        ({"videos/a.mp4": b"../../../../etc/passwd"}, ["videos/a.mp4", "not a mp4"]),
        ({"meta/info.json": b"/etc/passwd"}, ["meta/info.json", "not JSON"]),
        ({"notes.txt": b"x"}, ["'notes.txt'", "not part of a dataset"]),
        ({"meta/roborecover/scenarios.parquet": b"\x80\x04."}, ["scenarios.parquet"]),
    ],
)
def test_a_pull_refuses_what_no_dataset_holds_and_writes_nothing(hub, client, local, tmp_path, extra, words):
    put(hub, local, **extra)
    before = files_of(local)
    done = client.roborecover("pull", REPO, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert all(word in done.stderr for word in words), done.stderr
    assert {p.name for p in tmp_path.iterdir()} <= {"local", "hf"}
    assert files_of(local) == before


@pytest.mark.slow
def test_a_manifest_that_counts_otherwise_and_a_bomb_are_refused(hub, client, local, tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    manifest = json.loads((local / "meta/roborecover/manifest.json").read_text())
    manifest["counts"]["scenarios"] = 7
    put(hub, local, **{"meta/roborecover/manifest.json": json.dumps(manifest).encode()})
    done = client.roborecover("pull", REPO, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "counts.scenarios" in done.stderr
    bomb = tmp_path / "bomb.parquet"
    pq.write_table(pa.table({"x": [b"\0" * 2**27] * 4}), bomb, compression="zstd", use_dictionary=False)
    assert bomb.stat().st_size < 2**18
    put(hub, local, **{"data/chunk-000/file-000.parquet": bomb.read_bytes()})
    done = client.roborecover("pull", REPO, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "bytes uncompressed" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_folder_with_something_in_it_is_not_pulled_into(hub, client, local, tmp_path):
    put(hub, local)
    before = files_of(local)
    done = client.roborecover("pull", REPO, "--out", local)
    assert done.returncode == 2
    assert "not an empty folder" in done.stderr
    assert files_of(local) == before


@pytest.mark.parametrize(
    "failure", [["GET", "/tree/", 503, 2], ["GET", "/resolve/", 0, 1], ["GET", "/api/", 429, 2]]
)
def test_a_pull_survives_what_passes_by_itself(hub, client, local, tmp_path, failure):
    put(hub, local)
    hub.failures.append(failure)
    done = client.roborecover("pull", REPO, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert hub.failures[0][3] == 0
    assert files_of(tmp_path / "out") == files_of(local)


@pytest.mark.slow
def test_publish_then_pull_at_the_printed_revision_is_bit_identical(hub, client, local, tmp_path):
    commit = commit_of(client.publish(local))
    assert hub.repos[REPO].refs == {"main": commit, "roborecover-1.0.0": commit}
    for revision, name in ((commit, "a"), ("roborecover-1.0.0", "b"), (None, "c")):
        out = tmp_path / name
        done = client.roborecover("pull", REPO, "--out", out, *(["--revision", revision] if revision else []))
        assert done.returncode == 0, done.stderr
        assert commit in done.stdout
        assert [bits(s) for s in read_scenarios(out)] == [bits(s) for s in read_scenarios(local)]
        assert {k: v for k, v in files_of(out).items() if k.startswith("meta/")} == files_of(local)


@pytest.mark.slow
def test_an_evaluation_from_the_hub_is_bit_identical_to_one_from_the_folder(hub, client, local, tmp_path):
    commit = commit_of(client.publish(local))
    script = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from tests.support.loop import evaluate, outcomes
folder, hub, revision, out = sys.argv[2:]
here = evaluate(folder, Path(out) / "here.jsonl", trials=2, batch=2)
there = evaluate(hub, Path(out) / "there.jsonl", trials=2, batch=2, revision=revision)
assert len(here) == 12 and outcomes(here) == outcomes(there), (here, there)
assert all(row.handoff_identical for row in there)
"""
    done = client.run(script, Path(__file__).parents[2], local, REPO, commit, tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "name", ["../x.json", "meta/../../x.json", "/etc/x.json", "meta/a b.json", "x/meta.json"]
)
def test_names_that_leave_a_dataset_are_refused(name):
    with pytest.raises(ScenarioError, match="not part of a dataset"):
        check_names("set", [name])


def test_a_link_in_a_local_dataset_is_refused(local, tmp_path):
    (tmp_path / "secret.png").write_bytes(png())
    (local / "assets").mkdir()
    (local / "assets" / "a.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(ScenarioError, match="is a link"):
        list_files(local)


def test_caches_are_left_out_and_valid_files_pass(local):
    (local / ".cache").mkdir()
    (local / ".cache" / "x.bin").write_bytes(b"x")
    names = list_files(local)
    assert names == ["meta/roborecover/manifest.json", "meta/roborecover/scenarios.parquet"]
    for name in names:
        check_file(local, name)


@pytest.mark.nightly
@pytest.mark.lerobot
def test_a_dataset_with_episodes_is_published_for_lerobot_and_pulled_whole(hub, client, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_roborecover.datasets.write import write_episodes
    from lerobot_roborecover.platforms import make_simulator

    def camera():
        return make_simulator("fake", obs_type="pixels_agent_pos", observation_size=64)

    local = write_episodes(tmp_path / "set", [fake_scenario(i, steps=4) for i in range(3)], camera)
    commit = commit_of(client.publish(local))
    assert hub.repos[REPO].refs == {"main": commit, "roborecover-1.0.0": commit, "v3.0": commit}
    assert "assets/recovery_frames.png" in hub.repos[REPO].commits[commit]
    assert b"meta/roborecover/frames/" in hub.repos[REPO].commits[commit]["README.md"]
    second = commit_of(client.publish(local, "--version", "1.0.1", "--title", "Again"))
    assert hub.repos[REPO].refs["v3.0"] == second != commit
    done = client.roborecover("pull", REPO, "--revision", commit, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    pulled, written = files_of(tmp_path / "out"), files_of(local)
    assert {k: pulled.get(k) for k in written} == written
    assert LeRobotDataset("lab/x", root=tmp_path / "out").num_episodes == 3
    small = client.roborecover("pull", REPO, "--evaluation-only", "--out", tmp_path / "small")
    assert small.returncode == 0, small.stderr
    assert set(files_of(tmp_path / "small")) == {
        "meta/roborecover/manifest.json",
        "meta/roborecover/scenarios.parquet",
    }
    assert len(load_scenarios(tmp_path / "small")) == 3


@pytest.mark.lerobot
@pytest.mark.nightly
def test_a_trajectory_dataset_has_a_card_of_its_own(hub, client, tmp_path):
    from lerobot_roborecover.datasets.trajectories import read_trajectories
    from lerobot_roborecover.datasets.trajectory_write import write_trajectories
    from tests.datasets.test_trajectories import trajectory

    made = [trajectory(i, labels=[0, 0, 1, 1, 1]) for i in range(4)]
    local = write_trajectories(tmp_path / "monitor", "monitor", made, fps=20)
    commit = commit_of(client.publish(local))
    card = hub.repos[REPO].commits[commit]["README.md"].decode()
    for piece in ("label 0 before the recovery point", "| expert | 2 | 2 | 4 |", "| train:1 | 6 |"):
        assert piece in card, piece
    done = client.roborecover("pull", REPO, "--revision", "v3.0", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert read_trajectories(tmp_path / "out").rows == read_trajectories(local).rows
