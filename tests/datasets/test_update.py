"""A dataset that is changed in place is the old one or the new one, wherever the change is cut short."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.curation.funnel import Decision, read_decisions, record_decisions
from lerobot_roborecover.curation.split import SplitConfig
from lerobot_roborecover.curation.split_dataset import check_splits, split_dataset
from lerobot_roborecover.datasets import load_scenarios, read_scenarios, write_scenarios
from lerobot_roborecover.datasets.contents import list_files
from lerobot_roborecover.datasets.files import PENDING, finish_update, update_folder
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import last_frames
from lerobot_roborecover.datasets.schema import FOLDER, MANIFEST_FILE, SCENARIOS_FILE
from lerobot_roborecover.errors import InUseError
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_scenario
from tests.support.processes import PATIENCE_S

READERS = (read_scenarios, load_scenarios, FrameStore, read_decisions, list_files, finish_update)
"""How commands begin to read a dataset: each of them has to do with what a kill left."""


def contents(root: Path) -> dict[str, bytes]:
    """Every file that is part of the dataset."""
    return {
        p.relative_to(root).as_posix(): p.read_bytes()
        for p in sorted(root.rglob("*"))
        if p.is_file() and "roborecover-update" not in str(p.relative_to(root))
    }


def divide(root: Path, seed: int = 7) -> None:
    """Divides a dataset in place."""
    split_dataset(root, SplitConfig({"train": 0.5, "test": 0.5}, seed, ("record",)), force=True)


def replace_set(root: Path) -> None:
    """Writes fewer scenarios, without last frames, in the place of a dataset's."""
    write_scenarios(root, [fake_scenario(5)], description="another")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Three scenarios with last frames and decisions, divided before."""
    root = tmp_path_factory.mktemp("sets") / "set"
    simulator = make_simulator("fake", obs_type="pixels_agent_pos", observation_size=32)
    scenarios = [fake_scenario(n) for n in range(3)]
    write_scenarios(root, scenarios, frames=(last_frames(simulator, s) for s in scenarios))
    record_decisions(root, [Decision(s.id, "validate", "kept") for s in scenarios])
    divide(root, seed=1)
    return root


@pytest.mark.slow
@pytest.mark.parametrize("work", [divide, replace_set])
def test_a_kill_at_any_operation_leaves_the_old_or_the_new_set(source, tmp_path, monkeypatch, work):
    kills = tmp_path / "kills"
    command = [sys.executable, "-m", "tests.support.aimed_kills", f"{__name__}:{work.__name__}"]
    threadless = {"ARROW_DEFAULT_MEMORY_POOL": "system", "OPENBLAS_NUM_THREADS": "1"}
    ended = subprocess.run(
        [*command, str(source), str(kills)],
        env={**os.environ, **threadless}, capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    monkeypatch.setattr(os, "fsync", lambda number: None)
    assert ended.returncode == 0, ended.stderr
    operations = int(ended.stdout)
    assert operations > 15, "every write, rename and removal is one"
    old, new = contents(source), contents(kills / f"{operations:04d}" / "set")
    assert old != new
    seen: list[str] = []
    for operation in range(operations):
        root, reader = kills / f"{operation:04d}" / "set", READERS[operation % len(READERS)]
        reader(root)
        found = contents(root)
        assert found in (old, new), f"killed at operation {operation}, then {reader.__name__}"
        seen.append("old" if found == old else "new")
        if operation % 4 == 0 or seen[-2:] == ["old", "new"]:
            work(root)
            assert contents(root)[f"{FOLDER}/{SCENARIOS_FILE}"] == new[f"{FOLDER}/{SCENARIOS_FILE}"]
            assert [p.name for p in root.iterdir()] == ["meta"], "what the kill left is gone"
    assert seen == sorted(seen, reverse=True), "one commit"
    assert {"old", "new"} == set(seen)


def test_a_folder_that_is_replaced_as_a_whole_is_there_for_readers(source, tmp_path):
    """Its earlier one comes back where the process was killed between the two renames."""
    old, root = tmp_path / ".set.99999999.old", tmp_path / "set"
    for reader in READERS:
        shutil.copytree(source, old)
        reader(root)
        assert contents(root) == contents(source)
        assert not old.exists()
        shutil.rmtree(root)


def test_a_refused_update_changes_nothing(source, tmp_path):
    root = tmp_path / "set"
    shutil.copytree(source, root)

    def fails():
        with update_folder(root) as update:
            (update.folder / "meta").mkdir()
            (update.folder / "meta" / "info.json").write_text("{}")
            raise RuntimeError("full")

    with pytest.raises(RuntimeError, match="full"):
        fails()
    assert contents(root) == contents(source)
    assert [p.name for p in root.iterdir()] == ["meta"]


def test_one_update_at_a_time_and_none_of_a_file_in_use(source, tmp_path):
    root = tmp_path / "set"
    shutil.copytree(source, root)
    with update_folder(root), pytest.raises(InUseError, match="in use by another process"):
        divide(root)
    with open(root / FOLDER / "decisions.jsonl", "ab") as file:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(InUseError, match=r"decisions\.jsonl is in use"):
            divide(root)
    assert contents(root) == contents(source)
    divide(root)
    assert contents(root) != contents(source)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not the list of an update"),
        ("[]", "not the list of an update"),
        (json.dumps({"schema_version": 1, "put": ["../victim"], "remove": []}), "leaves the dataset"),
        (json.dumps({"schema_version": 1, "put": [], "remove": ["/etc/passwd"]}), "leaves the dataset"),
        (json.dumps({"schema_version": 9, "put": [], "remove": []}), "Upgrade it"),
        (None, "no update of this package"),
    ],
)
def test_an_update_of_another_program_is_refused(source, tmp_path, text, words):
    root, victim = tmp_path / "set", tmp_path / "victim"
    shutil.copytree(source, root)
    victim.write_text("mine")
    (root / PENDING).mkdir()
    if text is not None:
        (root / PENDING / "update.json").write_text(text)
    with pytest.raises(ScenarioError, match=words):
        read_scenarios(root)
    assert victim.read_text() == "mine"


def test_an_update_never_follows_a_link_out_of_the_dataset(source, tmp_path):
    root, outside = tmp_path / "set", tmp_path / "outside"
    shutil.copytree(source, root)
    outside.mkdir()
    (outside / "file").write_text("mine")
    (root / "data").symlink_to(outside)
    (root / PENDING / "data").mkdir(parents=True)
    (root / PENDING / "data" / "file").write_text("theirs")
    for changes in ({"put": ["data/file"], "remove": []}, {"put": [], "remove": ["data/file"]}):
        (root / PENDING / "update.json").write_text(json.dumps({"schema_version": 1, **changes}))
        with pytest.raises(ScenarioError, match="leaves the dataset"):
            read_scenarios(root)
    assert (outside / "file").read_text() == "mine"


def test_a_set_that_is_replaced_while_it_is_read_is_read_again(source, tmp_path, monkeypatch):
    from lerobot_roborecover.datasets import read

    root, parse = tmp_path / "set", read._read_manifest
    shutil.copytree(source, root)

    def replaced_after(folder):
        manifest = parse(folder)
        monkeypatch.setattr(read, "_read_manifest", parse)
        replace_set(root)
        return manifest

    monkeypatch.setattr(read, "_read_manifest", replaced_after)
    assert [s.id for s in read_scenarios(root)] == [fake_scenario(5).id]
    (root / FOLDER / MANIFEST_FILE).write_bytes((source / FOLDER / MANIFEST_FILE).read_bytes())
    with pytest.raises(ScenarioError, match="not of one writing"):
        read_scenarios(root)


def test_a_divided_copy_appears_divided(source, tmp_path, monkeypatch):
    from lerobot_roborecover.curation import split_dataset as module

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    out = tmp_path / "copy"
    with monkeypatch.context() as patched:
        patched.setattr(module, "_record", full)
        with suppress(OSError):
            split_dataset(source, SplitConfig({"train": 0.5, "test": 0.5}, 7, ("record",)), out=out)
    assert not out.exists()
    command = [
        "split",
        str(source),
        "--train",
        "0.5",
        "--test",
        "0.5",
        "--apart",
        "record",
        "--out",
        str(out),
    ]
    assert main(command) == 0
    assert check_splits(out, ("record",)).counts
    assert [p.name for p in out.iterdir()] == ["meta"]
