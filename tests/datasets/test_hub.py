"""Publishing and pulling scenario sets with the real `huggingface_hub` client against a local server.

The client reads its settings when it is imported, so each scene runs in a process of its own.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lerobot_roborecover.datasets import read_scenarios
from lerobot_roborecover.datasets.schema import FOLDER
from tests.support.factories import fake_dataset
from tests.support.hub_client import REPO
from tests.support.hub_server import TOKEN, Repo

FILES = {f"{FOLDER}/manifest.json", f"{FOLDER}/scenarios.parquet"}

LOAD = """
import json, logging, sys
logging.basicConfig(level=logging.WARNING, format="LOG %(message)s")
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.scenario import ScenarioError
try:
    s = load_scenarios(sys.argv[1], revision=sys.argv[2] or None)
except ScenarioError as err:
    print(json.dumps({"error": str(err)}))
else:
    print(json.dumps({"revision": s.revision, "sha256": [x.sha256() for x in s], "ids": list(s.ids)}))
"""

PUSH = """
import sys
from huggingface_hub import HfApi
api = HfApi()
api.create_repo(sys.argv[1], repo_type="dataset")
info = api.upload_folder(repo_id=sys.argv[1], folder_path=sys.argv[2], repo_type="dataset")
api.create_tag(sys.argv[1], tag="v1", repo_type="dataset", revision=info.oid)
print(info.oid)
"""


def loaded(process) -> dict:
    assert process.returncode == 0, process.stderr
    return json.loads(process.stdout.splitlines()[-1])


@pytest.fixture
def local(tmp_path):
    """A dataset folder with episodes' files beside the scenarios, as a published dataset has."""
    root = fake_dataset(tmp_path / "local", 3)
    (root / "data").mkdir()
    (root / "data" / "file-000.parquet").write_bytes(b"PAR1" + bytes(5000) + b"PAR1")
    (root / "README.md").write_text("---\nlicense: apache-2.0\n---\n# Recovery\n")
    return root


def publish(hub, root: Path, **settings) -> str:
    """Puts a folder on the server without going through the client; returns the commit."""
    files = {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}
    hub.repos[REPO] = Repo(**settings)
    return hub.repos[REPO].commit(files)


@pytest.mark.slow
def test_push_then_load_at_tag_and_commit_pulls_only_scenarios_and_certificate(hub, client, local):
    (local / FOLDER / "certificate.json").write_text("{}")
    pushed = client.run(PUSH, REPO, str(local), token=TOKEN)
    assert pushed.returncode == 0, pushed.stderr
    commit = pushed.stdout.split()[-1]
    expected = [s.sha256() for s in read_scenarios(local)]
    hub.log.clear()
    for revision in ("v1", commit):
        found = loaded(client.run(LOAD, REPO, revision))
        assert found["revision"] == commit
        assert found["sha256"] == expected
    fetched = {p.split("/resolve/")[1].split("/", 1)[1] for _, p in hub.log if "/resolve/" in p}
    assert fetched == {*FILES, f"{FOLDER}/certificate.json"}
    assert (
        hub.repos[REPO].commits[commit][f"{FOLDER}/scenarios.parquet"]
        == (local / FOLDER / "scenarios.parquet").read_bytes()
    )


def test_without_a_revision_the_commit_to_pin_is_logged(hub, client, local):
    commit = publish(hub, local)
    process = client.run(LOAD, REPO, "")
    assert loaded(process)["revision"] == commit
    assert any(
        line.startswith("LOG") and commit in line and "pin" in line for line in process.stderr.splitlines()
    )
    pinned = client.run(LOAD, REPO, commit)
    assert loaded(pinned)["revision"] == commit
    assert "LOG" not in pinned.stderr


@pytest.mark.slow
def test_a_moved_branch_is_followed_but_a_pinned_commit_stays(hub, client, local, tmp_path):
    first = publish(hub, local)
    assert len(loaded(client.run(LOAD, REPO, "main"))["ids"]) == 3
    larger = fake_dataset(tmp_path / "larger", 5)
    files = {str(p.relative_to(larger)): p.read_bytes() for p in larger.rglob("*") if p.is_file()}
    hub.repos[REPO].commit(files)
    assert len(loaded(client.run(LOAD, REPO, "main"))["ids"]) == 5
    assert len(loaded(client.run(LOAD, REPO, first))["ids"]) == 3


@pytest.mark.slow
def test_a_pinned_commit_in_the_cache_needs_no_network(hub, client, local):
    commit = publish(hub, local)
    loaded(client.run(LOAD, REPO, commit))
    hub.log.clear()
    assert loaded(client.run(LOAD, REPO, commit))["revision"] == commit
    assert hub.log == []
    assert loaded(client.run(LOAD, REPO, commit, offline=True))["revision"] == commit


def test_a_cached_branch_serves_when_the_hub_is_down_and_says_so(hub, client, local):
    commit = publish(hub, local)
    loaded(client.run(LOAD, REPO, "main"))
    process = client.run(LOAD, REPO, "main", endpoint="http://127.0.0.1:9")
    assert loaded(process)["revision"] == commit
    assert "did not answer" in process.stderr


@pytest.mark.parametrize(
    ("token", "settings", "revision", "words"),
    [
        ("", None, "", ["does not exist, or is private", "hf auth login"]),
        (TOKEN, None, "", ["does not exist"]),
        ("", {"private": True}, "", ["private", "HF_TOKEN"]),
        ("", {"gated": True}, "", ["gated", "accept its terms"]),
        ("", {}, "v9", ["'v9'", "no such tag"]),
    ],
)
def test_what_the_hub_refuses_becomes_one_clear_error(hub, client, local, token, settings, revision, words):
    if settings is not None:
        publish(hub, local, **settings)
    error = loaded(client.run(LOAD, REPO, revision, token=token))["error"]
    assert REPO in error
    assert all(word in error for word in words), error


@pytest.mark.parametrize(("offline", "endpoint"), [(True, ""), (False, "http://127.0.0.1:9")])
def test_no_network_and_no_copy_is_one_clear_error(hub, client, offline, endpoint):
    error = loaded(client.run(LOAD, REPO, "", offline=offline, endpoint=endpoint))["error"]
    assert "could not be downloaded" in error
    assert "HF_HUB_OFFLINE" in error


def test_a_dataset_without_scenarios_is_named_as_such(hub, client):
    hub.repos[REPO] = Repo()
    hub.repos[REPO].commit({"data/file-000.parquet": b"x"})
    assert "not a scenario dataset" in loaded(client.run(LOAD, REPO, ""))["error"]


@pytest.mark.nightly
@pytest.mark.slow
def test_a_pull_cut_half_way_never_loads_and_a_later_one_does(hub, client, local):
    commit = publish(hub, local)
    hub.cut.add(f"{FOLDER}/scenarios.parquet")
    assert "could not be downloaded" in loaded(client.run(LOAD, REPO, "main"))["error"]
    for revision in ("main", commit):
        assert "error" in loaded(client.run(LOAD, REPO, revision, offline=True))
    hub.cut.clear()
    assert loaded(client.run(LOAD, REPO, commit))["sha256"] == [s.sha256() for s in read_scenarios(local)]
