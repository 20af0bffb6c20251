"""Results on the Hub, against a server on loopback: metadata, the pull request, the board read back."""

from __future__ import annotations

from dataclasses import replace

import pytest
import yaml

from lerobot_roborecover.analysis.hub_board import HubResult, comparison_table
from lerobot_roborecover.analysis.hub_results import file_name, find_entry, results_yaml
from lerobot_roborecover.analysis.leaderboard import make_leaderboard
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.cli.main import main
from tests.support.hub_client import HubClient
from tests.support.hub_server import Repo
from tests.support.trial_rows import policy_rows, write_log

QUICK = Options(draws=300)
ON_HUB = {"dataset": "org/scenarios", "dataset_revision": "c0ffee"}


def made(tmp_path, **groups):
    for name, rows in groups.items():
        write_log(tmp_path / f"{name}.jsonl", rows)
    return make_leaderboard(tmp_path, QUICK)


def test_hub_metadata(tmp_path):
    rows = policy_rows("a", 28, 2, 0.5, 0, **ON_HUB) + policy_rows(
        "a", 28, 2, 0.9, 1, start="initial", **ON_HUB
    )
    found = made(tmp_path, a=rows)
    board, entry = find_entry(found, None)
    data = yaml.safe_load(results_yaml(board, entry))
    assert [d["dataset"]["task_id"] for d in data] == [
        "recovery_success_rate", "macro_recovery_success_rate", "initial_state_success_rate",
    ]  # fmt: skip
    assert data[0]["dataset"] | {"task_id": ""} == {
        "id": "org/scenarios",
        "task_id": "",
        "revision": "c0ffee",
    }
    assert data[0]["value"] == pytest.approx(100 * entry.rsr.value, abs=0.006)
    assert "28 scenarios, 56 trials, 0 invalid" in data[0]["notes"]
    assert "revision" not in yaml.safe_load(results_yaml(board, entry, "other/set"))[0]["dataset"]
    assert file_name(board) == ".eval_results/roborecover-org-scenarios-c0ffee-test.yaml"


def test_what_is_not_offered(tmp_path):
    found = made(tmp_path, a=policy_rows("a", 12, 2, 0.5, 0), b=policy_rows("b", 6, 2, 0.5, 1))
    with pytest.raises(RowsError, match="2 entries fit"):
        find_entry(found, None)
    board, entry = find_entry(found, "a")
    with pytest.raises(RowsError, match="'made-up' is not a data set on the Hub"):
        results_yaml(board, entry)
    with pytest.raises(RowsError, match="b covers 6 of 12 scenarios"):
        results_yaml(*find_entry(found, "b"), "org/set")


def test_the_source_and_the_date(tmp_path):
    board, entry = find_entry(made(tmp_path, a=policy_rows("a", 6, 2, 0.5, 0, **ON_HUB)), None)
    text = results_yaml(board, entry, source="https://example.org/log")
    assert "date: '2026-01-02T03:04:05" in text, "quoted: YAML would make a time of it"
    assert yaml.safe_load(text)[0]["source"] == {
        "url": "https://example.org/log",
        "name": "RoboRecover trial log",
    }
    with pytest.raises(RowsError, match=r"'log.jsonl'.*https://"):
        results_yaml(board, entry, source="log.jsonl")
    with pytest.raises(RowsError, match="was stopped when"):
        results_yaml(board, replace(entry, stopped=True))


def test_how_results_compare(tmp_path):
    local = made(tmp_path, a=policy_rows("me/a@1", 28, 2, 0.5, 0, **ON_HUB))
    (entry,) = local.boards[0].entries
    rate, rsr = round(100 * entry.rsr.value, 2), "recovery_success_rate"
    results = [
        HubResult("me/a", rsr, rate, None, None, ""),
        HubResult("org/copy", rsr, round(100 * entry.rsr.high, 2) - 0.5, "c0ffee", 3, "policy me/a@1; x"),
        HubResult("me/a", "macro_recovery_success_rate", 99.9, None, None, ""),
        HubResult("me/a", "initial_state_success_rate", 50.0, None, None, ""),
        HubResult("me/a", rsr, rate, "other", None, ""),
        HubResult("me/b", rsr, 1.0, None, None, ""),
    ]
    table = comparison_table("org/scenarios", results, local)
    said = sorted((row[0], row[1][:5], row[4]) for row in table.rows)
    assert said == sorted(
        [
            ("me/a", "recov", "the same"),
            ("org/copy", "recov", "within the interval"),
            ("me/a", "macro", "outside the interval"),
            ("me/a", "initi", "no local trials"),
            ("me/a", "recov", "another revision of the set (other)"),
            ("me/b", "recov", "no local trials"),
        ]
    )


def test_one_source_a_result(tmp_path, capsys):
    write_log(tmp_path / "a.jsonl", policy_rows("a", 6, 2, 0.5, 0, **ON_HUB))
    write_log(tmp_path / "b.jsonl", policy_rows("a", 6, 2, 0.5, 0, start="initial", **ON_HUB))
    common = ["leaderboard", str(tmp_path), f"--out={tmp_path / 'out'}", "--draws=200", "--hub=me/model"]
    assert main([*common, "--with-log", "--source=https://example.org/log"]) == 2
    assert "one source" in capsys.readouterr().err
    assert main([*common, "--with-log"]) == 2
    assert "roborecover merge" in capsys.readouterr().err


@pytest.mark.slow
def test_results_are_offered_and_read_back(hub, tmp_path):
    """The real client against a server on loopback, from a process whose Hub is that server."""
    write_log(tmp_path / "logs" / "a.jsonl", policy_rows("a", 28, 2, 0.5, 0, **ON_HUB))
    hub.repos["me/model"], hub.repos["org/scenarios"] = repo, board = Repo(), Repo()
    before = repo.commit({"README.md": b"# My model"})
    board.commit({"README.md": b"no benchmark"})
    hub.failures.append(["POST", "/commit/", 503, 1])
    client = HubClient(hub, tmp_path, tmp_path)
    command = ["leaderboard", tmp_path / "logs", f"--out={tmp_path / 'out'}", "--draws=200"]
    done = client.roborecover(*command, "--hub=me/model", "--with-log")
    assert done.returncode == 0, done.stderr
    assert f"offered   {hub.endpoint}/me/model/discussions/1" in done.stdout
    assert repo.refs["main"] == before, "nothing is pushed"
    files = repo.commits[repo.pull_requests[0]]
    log, results = (
        next(name for name in files if name.startswith(folder))
        for folder in ("roborecover/", ".eval_results/")
    )
    assert files[log] == (tmp_path / "logs" / "a.jsonl").read_bytes()
    first = yaml.safe_load(files[results])[0]
    assert first["dataset"]["id"] == "org/scenarios"
    assert first["source"]["url"] == f"{hub.endpoint}/me/model/blob/main/{log}"
    none = client.roborecover(*command, "--hub-board=org/scenarios")
    assert none.returncode == 2
    assert "Hub dataset org/scenarios: its leaderboard" in none.stderr
    board.commit({"eval.yaml": b"name: ours\n"})
    read = client.roborecover(*command, "--hub-board=org/scenarios")
    assert read.returncode == 0, read.stderr
    lines = [line for line in read.stdout.splitlines() if line.lstrip("| ").startswith("me/model")]
    assert len(lines) == 2, "RSR and Macro"
    assert all("the same" in line and "pull request 1" in line for line in lines)
    refused = client.roborecover(*command, "--hub=me/none")
    assert refused.returncode == 2
    assert "Hub model me/none" in refused.stderr
    assert "Traceback" not in refused.stderr
