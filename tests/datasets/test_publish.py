"""`dataset publish` against a server on loopback that speaks the Hub's protocol to the real client."""

from __future__ import annotations

import hashlib
import signal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.support.factories import fake_dataset
from tests.support.hub_client import CLI, REPO, commit_of
from tests.support.hub_server import TOKEN
from tests.support.processes import PATIENCE_S
from tests.support.release_files import files_of


@pytest.fixture
def local(tmp_path):
    return fake_dataset(tmp_path / "local", 6)


@pytest.mark.slow
def test_a_dry_run_says_everything_and_changes_nothing(hub, client, local):
    done = client.publish(local, "--dry-run", "--private")
    for piece in (
        "a new private repository",
        "+ README.md",
        "+ meta/roborecover/scenarios.parquet",
        "cc-by-4.0",
    ):
        assert piece in done.stdout
    assert not hub.repos
    assert hub.log
    assert all(method == "GET" for method, _ in hub.log)


@pytest.mark.slow
def test_a_private_repository_is_made_private(hub, client, local, tmp_path):
    client.publish(local, "--private")
    assert hub.repos[REPO].private
    done = client.roborecover("pull", REPO, "--out", tmp_path / "out", token="")
    assert done.returncode == 2
    assert "private" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_published_version_stays_unless_forced(hub, client, local, tmp_path):
    first = commit_of(client.publish(local))
    again = client.publish(local)
    assert "upload    0 files" in again.stdout
    assert commit_of(again) == first
    larger = fake_dataset(tmp_path / "larger", 8)
    refused = client.publish(larger, status=2)
    assert "version 1.0.0 is published already" in refused.stderr
    assert "--force" in refused.stderr
    assert hub.repos[REPO].refs["main"] == first
    second = commit_of(client.publish(larger, "--version", "1.1.0"))
    assert hub.repos[REPO].refs == {"main": second, "roborecover-1.0.0": first, "roborecover-1.1.0": second}
    third = commit_of(client.publish(local, "--version", "1.1.0", "--force"))
    assert hub.repos[REPO].refs["roborecover-1.1.0"] == third != second
    assert hub.repos[REPO].refs["roborecover-1.0.0"] == first


@pytest.mark.slow
def test_files_that_are_gone_leave_and_an_owner_s_card_stays(hub, client, local):
    (local / "data").mkdir()
    (local / "LICENSE").write_text("terms")
    client.publish(local)
    (local / "LICENSE").unlink()
    (local / "README.md").write_text("---\nlicense: mit\n---\nmy own words\n")
    done = client.publish(local, "--version", "2.0")
    assert "  - LICENSE" in done.stdout
    files = hub.repos[REPO].commits[commit_of(done)]
    assert "LICENSE" not in files
    assert b"my own words" in files["README.md"]


@pytest.mark.slow
def test_a_dropped_upload_is_resumed_without_sending_again_what_arrived(hub, client, local):
    add_episodes(local, 3)
    scenarios = (local / "meta/roborecover/scenarios.parquet").read_bytes()
    # The connection breaks in the middle of one file, every time, as when the network goes away.
    digest = hashlib.sha256(scenarios).hexdigest()
    hub.failures.append(["PUT", f"/lfs/{digest}", 0, 1000])
    refused = client.publish(local, status=2)
    assert "what is transferred is kept" in refused.stderr
    assert set(hub.repos[REPO].refs) == {"main"}
    assert list(hub.repos[REPO].commits.values()) == [{".gitattributes": b""}]
    assert len(hub.lfs) == 4, "one of the viewer's among them"
    hub.failures.clear()
    hub.log.clear()
    commit = commit_of(client.publish(local))
    assert [path for method, path in hub.log if method == "PUT"] == [f"/lfs/{digest}"]
    assert hub.repos[REPO].commits[commit]["meta/roborecover/scenarios.parquet"] == scenarios


STATUSES = [0, 429, 500, 503]
REQUESTS = [
    ("PUT", "/lfs/"), ("POST", "/preupload/"), ("POST", "/objects/batch"), ("POST", "/repos/create"),
    ("GET", "/refs"), ("POST", "/tag/"),
]  # fmt: skip
FAILURES = [
    pytest.param(*request, status, marks=() if at % len(STATUSES) == way else pytest.mark.nightly)
    for at, request in enumerate(REQUESTS)
    for way, status in enumerate(STATUSES)
]
"""Each request that may fail, in each way; by default one way of each."""


@pytest.mark.slow
@pytest.mark.parametrize(("method", "pattern", "status"), FAILURES)
def test_what_fails_twice_and_then_works_is_published(hub, client, local, method, pattern, status):
    hub.failures.append([method, pattern, status, 2])
    done = client.publish(local)
    assert hub.failures[0][3] == 0
    assert hub.repos[REPO].refs["roborecover-1.0.0"] == commit_of(done)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("failure", "words"),
    [
        (["POST", "/repos/create", 403, 9], ["403", "may not do this", "hf auth login"]),
        pytest.param(["POST", "/repos/create", 401, 9], ["401", "HF_TOKEN"], marks=pytest.mark.nightly),
        (["POST", "/commit/", 409, 9], ["409", "another commit"]),
        pytest.param(["POST", "/commit/", 413, 9], ["413", "refused"], marks=pytest.mark.nightly),
        pytest.param(["POST", "/tag/", 429, 99], ["429", "slow down"], marks=pytest.mark.nightly),
        (["GET", "/refs", 500, 99], ["did not answer properly after 5 attempts"]),
    ],
)
def test_what_the_hub_refuses_is_one_clear_line_and_no_version(hub, client, local, failure, words):
    hub.failures.append(failure)
    done = client.publish(local, status=2)
    assert all(word in done.stderr for word in words), done.stderr
    assert "Traceback" not in done.stderr
    assert "roborecover-1.0.0" not in (hub.repos[REPO].refs if REPO in hub.repos else {})


@pytest.mark.slow
def test_a_commit_of_another_client_in_between_is_not_overwritten(hub, client, local, tmp_path):
    client.publish(local)
    script = CLI.replace(
        "sys.exit(main(sys.argv[1:]))",
        "import lerobot_roborecover.datasets.publish as p\n"
        "real = p.publish\n"
        "def late(plan, progress):\n"
        "    object.__setattr__(plan, 'head', '0' * 40)\n"
        "    return real(plan, progress)\n"
        "p.publish = late\n"
        "sys.exit(main(sys.argv[1:]))",
    )
    larger = fake_dataset(tmp_path / "larger", 8)
    done = client.run(
        script, "publish", larger, "--repo-id", REPO, "--license", "mit", "--version", "2.0", token=TOKEN
    )
    assert done.returncode == 2, done.stdout
    assert "412" in done.stderr
    assert "roborecover-2.0" not in hub.repos[REPO].refs


@pytest.mark.slow
def test_a_dataset_that_is_not_valid_is_not_published(hub, client, local):
    path = local / "meta/roborecover/scenarios.parquet"
    path.write_bytes(path.read_bytes()[:-8] + b"00000000")
    assert "scenarios.parquet" in client.publish(local, status=2).stderr
    assert not hub.log


@pytest.mark.parametrize("offline", [True, False])
def test_a_dry_run_needs_no_hub_and_says_what_it_does_not_know(hub, client, local, offline):
    where = {} if offline else {"endpoint": "http://127.0.0.1:9"}
    done = client.publish(local, "--dry-run", offline=offline, **where)
    assert not hub.log
    for piece in (
        f"to        {REPO}; if it does not exist, a new public repository is made",
        "unknown   what is there already",
        "upload    at most 5 files",
        "  + README.md",
        "  + meta/roborecover/scenarios.parquet",
        "tags      roborecover-1.0.0",
        "licence   cc-by-4.0",
        "HF_HUB_OFFLINE" if offline else "did not answer",
    ):
        assert piece in done.stdout, done.stdout
    if offline:
        assert client.publish(local, offline=True, status=2).stdout == ""


def add_episodes(local, count: int, size: int = 1) -> None:
    """Puts random parquet files beside the scenarios, as episodes would be."""
    (local / "data" / "chunk-000").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for i in range(count):
        table = pa.table({"x": rng.integers(0, 2**62, size)})
        pq.write_table(table, local / "data" / "chunk-000" / f"file-{i:03d}.parquet")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "pattern"),
    [
        pytest.param("PUT", "/lfs/", marks=pytest.mark.nightly),
        ("POST", "/commit/"),
        pytest.param("POST", "/tag/", marks=pytest.mark.nightly),
    ],
)
def test_a_publication_that_is_killed_shows_nothing_half_and_goes_on(hub, client, local, method, pattern):
    add_episodes(local, 2)
    hold = hub.hold(method, pattern, skip=1 if method == "PUT" else 0)
    process = client.start(CLI, "publish", local, "--repo-id", REPO, "--license", "mit", token=TOKEN)
    try:
        assert hold.reached.wait(PATIENCE_S), "it never got there"
    finally:
        process.kill()
        process.communicate()
        hold.release.set()
    assert process.returncode == -signal.SIGKILL
    repo, arrived = hub.repos[REPO], set(hub.lfs)
    assert set(repo.refs) == {"main"}
    assert ("README.md" in repo.commits[repo.refs["main"]]) == (pattern == "/tag/")
    hub.log.clear()
    done = client.publish(local, "--license", "mit")
    assert repo.refs == {"main": commit_of(done), "roborecover-1.0.0": commit_of(done)}
    files = repo.commits[commit_of(done)]
    assert {n: files[n] for n in files_of(local)} == files_of(local)
    sent = {path.removeprefix("/lfs/") for sent_by, path in hub.log if sent_by == "PUT"}
    assert bool(sent) == (pattern == "/lfs/")
    assert not sent & arrived, "what had arrived was sent again"


@pytest.mark.slow
def test_a_large_file_goes_in_parts_and_a_part_that_is_cut_goes_again(hub, client, local):
    add_episodes(local, 1, size=2**17)
    name = "data/chunk-000/file-000.parquet"
    data = (local / name).read_bytes()
    assert len(data) > 2**20
    hub.part_bytes = 2**18
    hub.failures.append(["PUT", "/lfs-part/.*/3", 0, 1])
    done = client.publish(local)
    assert hub.failures[0][3] == 0
    assert hub.repos[REPO].commits[commit_of(done)][name] == data
    parts = [path.rsplit("/", 1)[1] for method, path in hub.log if path.startswith("/lfs-part/")]
    assert parts == ["1", "2", "3", "3", *map(str, range(4, -(-len(data) // 2**18) + 1))]
    assert sum(path == "/lfs-complete" for _, path in hub.log) == 1
