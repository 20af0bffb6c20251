"""`roborecover leaderboard`: boards of what may be compared, provenance, the page, and results on the Hub."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import yaml

from lerobot_roborecover.analysis.estimators import RowsError
from lerobot_roborecover.analysis.hub_results import file_name, find_entry, results_yaml
from lerobot_roborecover.analysis.leaderboard import as_json, make_leaderboard, ranks
from lerobot_roborecover.analysis.leaderboard_page import board_table, write_leaderboard
from lerobot_roborecover.analysis.results import Options
from lerobot_roborecover.cli.main import main
from tests.support.browser import open_page
from tests.support.hub_client import HubClient
from tests.support.hub_server import HubServer, Repo
from tests.support.trial_rows import policy_rows, trial_row, write_log

QUICK = Options(draws=300)
ON_HUB = {"dataset": "org/scenarios", "dataset_revision": "c0ffee"}


def made(tmp_path, **groups):
    for name, rows in groups.items():
        write_log(tmp_path / f"{name}.jsonl", rows)
    return make_leaderboard(tmp_path, QUICK)


def test_order_ranks_and_standing(tmp_path):
    found = made(
        tmp_path,
        weak=policy_rows("weak", 20, 3, 0.15, 0),
        strong=policy_rows("strong", 20, 3, 0.85, 1) + policy_rows("strong", 20, 3, 0.9, 2, start="initial"),
        partial=policy_rows("partial", 10, 3, 0.95, 3),
        helped=[replace(r, interventions=[["rollback", 3]]) for r in policy_rows("helped", 20, 3, 0.95, 4)],
    )
    (board,) = found.boards
    assert board.scenarios == 20
    assert [e.policy for e in board.entries] == ["strong", "weak", "partial", "helped"]
    assert ranks(board) == ["1", "2", "", ""]
    standings = [row[4] for row in board_table(board).rows]
    assert standings == ["best", "behind the best", "incomplete", "intervention"]
    strong, weak = board.entries[:2]
    assert strong.behind.value == 0
    assert weak.behind.value == pytest.approx(strong.rsr.value - weak.rsr.value)
    assert math.isnan(weak.initial.value)
    assert not math.isnan(strong.initial.low)


def test_what_cannot_be_compared_gets_boards_of_its_own(tmp_path):
    found = made(
        tmp_path,
        a=[trial_row(n) for n in range(3)],
        b=[trial_row(n, versions={"mujoco": "3.4.0"}) for n in range(3)],
        c=[trial_row(n, platform="metaworld") for n in range(3)],
        d=[trial_row(n, dataset_revision="r2") for n in range(3)],
        e=[trial_row(n, options={"handoff_check": False}) for n in range(3)],
        f=[trial_row(n, options={"approximate_snapshots": True}) for n in range(3)],
    )
    assert len(found.boards) == 6
    assert any("approximate snapshots" in board.dataset for board in found.boards)
    assert any("handoff not checked" in board.dataset for board in found.boards)
    assert found.refused == ()


def test_shards_of_one_run_are_one_entry(tmp_path):
    rows = policy_rows("a", 12, 2, 0.5, 0)
    found = made(tmp_path, s0=rows[::2], s1=rows[1::2])
    (entry,) = found.boards[0].entries
    assert (entry.scenarios, entry.trials, len(entry.provenance.logs)) == (12, 24, 2)


def test_two_settings_of_a_policy_are_two_entries(tmp_path):
    first = policy_rows("a", 12, 2, 0.5, 0)
    second = [replace(r, execution_horizon=50, config_hash="other") for r in policy_rows("a", 12, 2, 0.5, 1)]
    (board,) = made(tmp_path, first=first, second=second).boards
    assert sorted(e.provenance.execution_horizon for e in board.entries) == [10, 50]


def test_bad_logs_are_listed_and_the_others_stay(tmp_path):
    (tmp_path / "bad.jsonl").write_text("not json\n")
    (tmp_path / "empty.jsonl").write_text("")
    found = made(
        tmp_path,
        good=policy_rows("good", 5, 2, 0.5, 0),
        one=[trial_row(0, policy="torn", success=True)],
        two=[trial_row(0, policy="torn", success=False)],
    )
    assert [e.policy for e in found.boards[0].entries] == ["good"]
    reasons = dict(found.refused)
    assert "not a JSON trial row" in reasons["bad.jsonl"]
    assert reasons["empty.jsonl"] == "it holds no complete row"
    assert "one.jsonl and two.jsonl contradict each other on trial 0 of s000" in reasons["torn"]
    with pytest.raises(RowsError, match="no trial logs"):
        make_leaderboard(tmp_path / "nowhere")


def test_only_initial_trials_make_no_board(tmp_path):
    found = made(tmp_path, a=policy_rows("a", 3, 1, 0.5, 0, start="initial"))
    assert found.boards == ()
    assert found.refused[0][1] == "no trials from recovery points"


@pytest.mark.browser
def test_json_and_page(tmp_path):
    found = made(tmp_path / "logs", a=policy_rows("<i>a</i>", 12, 2, 0.5, 0), b=[trial_row(0, policy="b")])
    page, data = write_leaderboard(found, tmp_path / "out")
    read = json.loads(data.read_text())
    assert read == json.loads(json.dumps(as_json(found)))
    entry = read["boards"][0]["entries"][0]
    assert entry["provenance"]["versions"] == {"lerobot": "0.6.1", "mujoco": "3.3.2"}
    assert entry["provenance"]["logs"][0].startswith("a.jsonl ")
    assert read["boards"][0]["entries"][1]["rsr"]["low"] is None
    assert len(read["published_not_rerun"]) == 12
    with open_page(page, tmp_path / "profile") as (shown, complaints):
        assert shown.locator("table").count() == 2
        headings = shown.locator("h2, h3").all_text_contents()
        assert sum(found.boards[0].scenario_set in text for text in headings) == 1
        assert shown.locator("tbody tr").count() == 2 + 6, "the paper's rows of this platform alone"
        shown.locator("summary").first.click()
        assert shown.locator("details[open] dd").first.is_visible()
        assert "<i>a</i>" in shown.locator("tbody tr").first.text_content()
        assert complaints == []


def test_hub_metadata(tmp_path):
    rows = policy_rows("a", 12, 2, 0.5, 0, **ON_HUB) + policy_rows(
        "a", 12, 2, 0.9, 1, start="initial", **ON_HUB
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
    assert "12 scenarios, 24 trials, 0 invalid" in data[0]["notes"]
    assert "revision" not in yaml.safe_load(results_yaml(board, entry, "other/set"))[0]["dataset"]
    assert file_name(board) == ".eval_results/roborecover-org-scenarios-c0ffee-test.yaml"


def test_what_is_not_pushed(tmp_path):
    found = made(tmp_path, a=policy_rows("a", 12, 2, 0.5, 0), b=policy_rows("b", 6, 2, 0.5, 1))
    with pytest.raises(RowsError, match="2 entries fit"):
        find_entry(found, None)
    board, entry = find_entry(found, "a")
    with pytest.raises(RowsError, match="'made-up' is not a data set on the Hub"):
        results_yaml(board, entry)
    with pytest.raises(RowsError, match="b covers 6 of 12 scenarios"):
        results_yaml(*find_entry(found, "b"), "org/set")


def test_command(tmp_path, capsys):
    write_log(tmp_path / "logs" / "a.jsonl", policy_rows("a", 6, 2, 0.5, 0))
    common = ["leaderboard", str(tmp_path / "logs"), f"--out={tmp_path / 'out'}", "--draws=200"]
    assert main(common) == 0
    assert "libero: made-up@r1, test" in capsys.readouterr().out
    assert main([*common, "--push-to=me/model", "--dataset-id=org/set", "--dry-run"]) == 0
    assert "dry run: nothing was pushed" in capsys.readouterr().out
    (tmp_path / "logs" / "bad.jsonl").write_text("{}\n")
    assert main(common) == 1
    assert "not used: bad.jsonl" in capsys.readouterr().out


@pytest.mark.slow
def test_results_arrive_beside_the_model_card(tmp_path):
    """The real client against a server on loopback, from a process whose Hub is that server."""
    write_log(tmp_path / "logs" / "a.jsonl", policy_rows("a", 6, 2, 0.5, 0, **ON_HUB))
    with HubServer() as server:
        server.repos["me/model"] = Repo()
        server.repos["me/model"].commit({"README.md": b"# My model"})
        server.failures.append(["POST", "/commit/", 503, 1])
        client = HubClient(server, tmp_path, tmp_path)
        command = ["leaderboard", tmp_path / "logs", f"--out={tmp_path / 'out'}", "--draws=200"]
        done = client.roborecover(*command, "--push-to=me/model")
        assert done.returncode == 0, done.stderr
        repo = server.repos["me/model"]
        files = repo.commits[repo.refs["main"]]
        assert files["README.md"] == b"# My model"
        (pushed,) = [name for name in files if name.startswith(".eval_results/")]
        assert yaml.safe_load(files[pushed])[0]["dataset"]["id"] == "org/scenarios"
        refused = client.roborecover(*command, "--push-to=me/none")
    assert refused.returncode == 2
    assert "Hub model me/none" in refused.stderr
    assert "Traceback" not in refused.stderr
