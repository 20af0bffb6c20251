"""`roborecover compare`: the difference, its reasons, the verdict, and what it refuses."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import pytest

from lerobot_roborecover.analysis.compare import compare, to_json, to_screen
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.cli.main import main
from lerobot_roborecover.logs.merge import merge
from lerobot_roborecover.logs.trial_log import TrialLogError
from tests.support.trial_rows import policy_rows, trial_row, write_log

QUICK = Options(draws=1000)


def study(tmp_path, *groups):
    return read_study([str(write_log(tmp_path / f"{n}.jsonl", rows)) for n, rows in enumerate(groups)])


def pair(tmp_path, first, second, count=40, **kwargs):
    return study(
        tmp_path, policy_rows("a", count, 5, first, 0), policy_rows("b", count, 5, second, 1), **kwargs
    )


def test_a_clear_winner(tmp_path):
    found = compare(pair(tmp_path, 0.85, 0.15), options=QUICK)
    assert found.verdict == f"a is better, by {100 * found.contrast.difference.value:.1f} points."
    other = compare(pair(tmp_path, 0.85, 0.15), "b", "a", QUICK)
    assert other.verdict == found.verdict
    assert other.contrast.difference.value == pytest.approx(-found.contrast.difference.value)
    assert other.contrast.p == pytest.approx(found.contrast.p)


def test_too_close_to_call_names_no_number_after_the_fact(tmp_path):
    found = compare(pair(tmp_path, 0.5, 0.5), options=QUICK)
    assert not found.contrast.difference.low > 0
    assert found.verdict.startswith("Not separated with these trials: ")
    assert "roborecover plan" in found.verdict
    assert not re.search(r"\d+ (more )?scenarios", found.verdict)


def test_cells_add_up_and_the_screen_shows_them(tmp_path):
    found = compare(pair(tmp_path, 0.6, 0.4), options=QUICK)
    assert sum(s.contribution for s in found.cells) == pytest.approx(found.contrast.difference.value)
    assert sum(s.scenarios for s in found.cells) == found.scenarios == 40
    screen = to_screen(found)
    shown = [float(x) for x in re.findall(r"^  \S.*?  +([+-]\d+\.\d)   \(A − B", screen, re.M)]
    assert len(shown) == 4
    assert sum(shown) == pytest.approx(100 * found.contrast.difference.value, abs=0.21)
    assert "the only pair of its family" in screen
    assert "over 40 scenarios: they speak of other scenarios like these, of these tasks" in screen
    assert max(map(len, screen.splitlines())) <= 110
    assert screen.count("\n") < 30


def test_p_is_adjusted_for_all_pairs_of_the_logs(tmp_path):
    three = study(
        tmp_path,
        *(policy_rows(p, 40, 5, r, n) for n, (p, r) in enumerate([("a", 0.55), ("b", 0.45), ("c", 0.5)])),
    )
    with pytest.raises(RowsError, match="say which two with --a and --b; there are: a, b, c"):
        compare(three, options=QUICK)
    found = compare(three, "a", "b", QUICK)
    assert found.contrast.family == 3
    assert found.contrast.p_holm >= found.contrast.p
    assert "adjusted for 3 pairs (Holm)" in to_screen(found)


def test_a_is_the_policy_whose_log_was_named_first(tmp_path):
    worse, better = policy_rows("worse", 40, 5, 0.2, 0), policy_rows("better", 40, 5, 0.8, 1)
    found = compare(study(tmp_path, worse, better), options=QUICK)
    assert (found.contrast.a, found.contrast.b) == ("worse", "better")


def test_clear_alone_but_not_after_adjustment(tmp_path):
    """b is ahead on 25 scenarios of 60, a on 12: p is about 0.03, which ten pairs do not leave standing."""
    solved = {
        "a": set(range(12)),
        "b": set(range(12, 37)),
        "c": set(range(20)),
        "d": set(range(20)),
        "e": {0},
    }
    groups = [[trial_row(n, success=n in solved[p], policy=p) for n in range(60)] for p in solved]
    alone = compare(study(tmp_path / "two", *groups[:2]), options=QUICK)
    assert alone.contrast.p == pytest.approx(0.033, abs=0.015)
    assert alone.verdict == "b is better, by 21.7 points."
    found = compare(study(tmp_path, *groups), "a", "b", QUICK)
    assert found.verdict.startswith("Not separated once p is adjusted for the 10 pairs")


def test_one_scenario_and_no_difference(tmp_path):
    one = compare(pair(tmp_path, 0.9, 0.1, count=1), options=QUICK)
    assert one.verdict.startswith("No verdict: the two differ on 1 of 1 scenarios, and below 6 no test")
    assert "interval n/a" in to_screen(one)
    assert "nan" not in to_screen(one)
    assert to_json(one)["contrast"]["difference"]["low"] is None
    same = study(tmp_path / "same", *[[trial_row(n, policy=p) for n in range(5)] for p in "ab"])
    assert compare(same, options=QUICK).verdict.startswith("No verdict: the two differ on 0 of 5")


def test_common_scenarios_only(tmp_path):
    first = [trial_row(n, policy="a") for n in range(12)]
    second = [trial_row(n, policy="b", success=n % 2 == 0) for n in range(6, 18)]
    found = compare(study(tmp_path, first, second), options=QUICK)
    assert found.scenarios == 6
    assert found.contrast.difference.value == 0.5
    assert any("only 6 of 18 scenarios, which both were run on" in r for r in found.remarks)
    apart = study(tmp_path / "apart", first[:3], [trial_row(n, policy="b") for n in range(5, 9)])
    with pytest.raises(RowsError, match="there is none in common"):
        compare(apart, options=QUICK)


def test_initial_states_are_shown_where_both_have_them(tmp_path):
    groups = [
        policy_rows(p, 20, 3, 0.5, n) + policy_rows(p, 20, 2, initial, n + 9, start="initial")
        for n, (p, initial) in enumerate([("a", 0.9), ("b", 0.2)])
    ]
    found = compare(study(tmp_path, *groups), options=QUICK)
    assert found.initial.difference.value > 0.3
    assert "points from initial states" in to_screen(found)
    assert compare(pair(tmp_path / "none", 0.5, 0.5), options=QUICK).initial is None


def test_reversion_is_told_from_a_policy(tmp_path):
    both = study(
        tmp_path,
        policy_rows("a", 15, 2, 0.4, 0),
        policy_rows("a", 15, 2, 0.6, 1, start="reversion", rewind_steps=30),
    )
    found = compare(both, options=QUICK)
    assert {found.a, found.b} == {"a", "a, 30 steps back"}
    assert any("this measures the intervention, not a policy" in r for r in found.remarks)


def test_reversion_by_the_papers_rule_is_one_arm(tmp_path):
    rule = {"start": "reversion", "options": {"rewind_rule": "paper"}}
    short = policy_rows("a", 4, 2, 0.6, 1, rewind_steps=30, **rule)
    rows = [r if i < 4 else replace(r, rewind_steps=60) for i, r in enumerate(short)]
    (arm,) = read_study([str(write_log(tmp_path / "rule.jsonl", rows))]).arms
    assert arm.title == "a, 30 or 60 steps back"
    assert len(arm.rows) == 8
    assert len(merge([tmp_path / "rule.jsonl"], tmp_path / "merged.jsonl").rows) == 8
    told = write_log(tmp_path / "told.jsonl", [replace(r, trial=9, options={}) for r in rows[:1]])
    with pytest.raises(TrialLogError, match=r"rewind_steps is None .* 30"):
        merge([tmp_path / "rule.jsonl", told], tmp_path / "other.jsonl")


def test_command(tmp_path, capsys):
    logs = [
        str(write_log(tmp_path / f"{p}.jsonl", policy_rows(p, 20, 3, r, 0)))
        for p, r in (("a", 0.9), ("b", 0.1))
    ]
    assert main(["compare", *logs, "--draws=500"]) == 0
    assert "a is better" in capsys.readouterr().out
    assert main(["compare", *logs, "--draws=500", "--seed=3", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert (data["a"], data["resampling"]["units"]) == ("a", 20)
    assert not math.isnan(data["contrast"]["p_holm"])
    assert main(["compare", logs[0]]) == 2
    assert "takes two policies" in capsys.readouterr().err
    assert main(["compare", *logs, "--a=a", "--b=z"]) == 2
    assert "no policy 'z'" in capsys.readouterr().err
    other = write_log(tmp_path / "other.jsonl", [trial_row(0, policy="c", scenario_sha256="e" * 64)])
    assert main(["compare", logs[0], str(other)]) == 2
    assert "different scenario sets" in capsys.readouterr().err
