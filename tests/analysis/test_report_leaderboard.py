"""`roborecover leaderboard`: boards of what may be compared, provenance, and the page."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from lerobot_roborecover.analysis.board import ranks
from lerobot_roborecover.analysis.leaderboard import as_json, make_leaderboard
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.pages.leaderboard import board_table, write_leaderboard
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.cli.main import main
from tests.support.browser import open_page
from tests.support.trial_rows import policy_rows, trial_row, write_log

QUICK = Options(draws=300)


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


def test_a_policy_without_a_valid_trial_has_no_rate_and_comes_last(tmp_path):
    broken = [replace(r, outcome="policy_error", success=False) for r in policy_rows("broken", 8, 2, 0.5, 0)]
    (board,) = made(tmp_path, broken=broken, working=policy_rows("working", 8, 2, 0.5, 1)).boards
    assert [e.policy for e in board.entries] == ["working", "broken"]
    assert all(math.isnan(e.value) for e in (board.entries[1].rsr, board.entries[1].behind))
    assert ranks(board) == ["1", ""]
    assert [row[4] for row in board_table(board).rows] == ["best", "no valid trial"]


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
        command = shown.locator("details pre").text_content()
        assert "--env roborecover_libero --env.scenarios=made-up --env.revision=r1 " in command
        assert command.count("--eval.n_episodes=2") == command.count("roborecover eval") == 2
        assert shown.locator("#submit").count() == 1
        assert complaints == []


def test_command(tmp_path, capsys):
    write_log(tmp_path / "logs" / "a.jsonl", policy_rows("a", 6, 2, 0.5, 0))
    common = ["leaderboard", str(tmp_path / "logs"), f"--out={tmp_path / 'out'}", "--draws=200"]
    assert main(common) == 0
    assert "libero: made-up@r1, test" in capsys.readouterr().out
    assert main([*common, "--hub=me/model", "--dataset-id=org/set", "--dry-run"]) == 0
    assert "dry run: nothing was offered" in capsys.readouterr().out
    (tmp_path / "logs" / "bad.jsonl").write_text("{}\n")
    assert main(common) == 1
    assert "not used: bad.jsonl" in capsys.readouterr().out
