"""A published set as the Hub's benchmark and viewer see it: `eval.yaml`, configs, tables by split."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import pyarrow.parquet as pq
import pytest
import yaml
from PIL import Image

from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.datasets.benchmark import TASKS, split_names
from tests.support.factories import fake_scenario
from tests.support.hub_client import REPO, commit_of

STREAM = """
import json, sys
from datasets import load_dataset

found = load_dataset(sys.argv[1], streaming=True)
first, second, *_ = found["test"]
print(json.dumps({
    "splits": {name: len(list(part)) for name, part in found.items()},
    "first": [first["id"], first["stage"], first["prefix_steps"]],
    "frames": [first["recovery_frame"], list(second["recovery_frame"].size)],
}))
"""


def png(color=(200, 30, 30)) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (320, 240), color).save(buffer, "PNG")
    return buffer.getvalue()


@pytest.fixture
def local(tmp_path):
    """Six scenarios of two splits, all but the first with a picture."""
    scenarios = [replace(fake_scenario(i), split="test" if i < 4 else "dev-1") for i in range(6)]
    for s in scenarios[1:]:
        object.__setattr__(s.fingerprint, "frames_png", (png(),))
    return write_scenarios(tmp_path / "set", scenarios)


def published(hub, client, root, *args) -> dict[str, bytes]:
    commit = commit_of(client.publish(root, *args))
    return hub.repos[REPO].commits[commit]


def metadata_of(files: dict[str, bytes]) -> dict:
    return yaml.safe_load(files["README.md"].decode().split("---\n")[1])


@pytest.mark.slow
def test_the_benchmark_and_its_splits(hub, client, local):
    files = published(hub, client, local, "--title", "Our set")
    about = yaml.safe_load(files["eval.yaml"])
    assert about["name"] == "Our set"
    assert about["evaluation_framework"] == "roborecover"
    assert [task["id"] for task in about["tasks"]] == list(TASKS)
    (config,) = metadata_of(files)["configs"]
    assert {(t["config"], t["split"]) for t in about["tasks"]} == {(config["config_name"], "test")}
    assert config["default"]
    paths = {f["split"]: f["path"] for f in config["data_files"]}
    assert paths == {"dev_1": "viewer/dev_1.parquet", "test": "viewer/test.parquet"}
    rows = pq.read_table(io.BytesIO(files[paths["test"]])).to_pylist()
    assert [r["id"] for r in rows] == [fake_scenario(i).id for i in range(4)]
    assert rows[0]["recovery_frame"] is None
    with Image.open(io.BytesIO(rows[1]["recovery_frame"]["bytes"])) as image:
        assert image.size == (256, 192)
    bare = published(hub, client, local, "--no-pictures", "--version", "2.0")
    assert "recovery_frame" not in pq.read_schema(io.BytesIO(bare[paths["test"]])).names


def test_names_of_splits_stay_apart():
    scenarios = [replace(fake_scenario(i), split=name) for i, name in enumerate(("a-b", "a_b", "c.d"))]
    assert split_names(scenarios) == {"a-b": "a_b", "a_b": "a_b_", "c.d": "c_d"}


@pytest.mark.slow
def test_an_owner_s_benchmark_stays_and_tables_of_splits_that_are_gone_leave(hub, client, local, tmp_path):
    published(hub, client, local)
    client.roborecover("pull", REPO, "--out", tmp_path / "pulled")
    pulled = tmp_path / "pulled"
    assert (pulled / "viewer/dev_1.parquet").is_file()
    write_scenarios(tmp_path / "one", [fake_scenario(i) for i in range(3)])
    for name in ("scenarios.parquet", "manifest.json"):
        (pulled / "meta/roborecover" / name).write_bytes(
            (tmp_path / "one/meta/roborecover" / name).read_bytes()
        )
    (pulled / "eval.yaml").write_text("name: my own\n")
    files = published(hub, client, pulled, "--version", "2.0")
    assert [name for name in files if name.startswith("viewer/")] == ["viewer/test.parquet"]
    assert files["eval.yaml"] == b"name: my own\n"


@pytest.mark.nightly
@pytest.mark.slow
def test_scenarios_stream_into_datasets(hub, client, local):
    published(hub, client, local)
    done = client.run(STREAM, REPO)
    assert done.returncode == 0, done.stderr[-3000:]
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["splits"] == {"dev_1": 2, "test": 4}
    assert said["first"] == [fake_scenario(0).id, fake_scenario(0).stage.value, len(fake_scenario(0).prefix)]
    assert said["frames"] == [None, [256, 192]]
