"""What is claimed: verdicts from Holm-adjusted sign flips, between complete policies, the same everywhere."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.board import ranks, separated
from lerobot_roborecover.analysis.compare import compare, to_screen
from lerobot_roborecover.analysis.figures.rates import forest, paired_differences
from lerobot_roborecover.analysis.figures.trials import oracle_bars
from lerobot_roborecover.analysis.headline import headline
from lerobot_roborecover.analysis.leaderboard import make_leaderboard
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.pages.leaderboard import board_table
from lerobot_roborecover.analysis.pair_tables import paired_contrasts
from lerobot_roborecover.analysis.policy_tables import overall
from lerobot_roborecover.analysis.report_tables import interventions, oracle_table
from lerobot_roborecover.analysis.stats.complete_subset import compared
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.permutation import _random_flips, sign_flip_p
from lerobot_roborecover.analysis.stats.verdicts import ComparisonVerdict
from lerobot_roborecover.cli.main import main
from tests.support.trial_rows import policy_rows, trial_row, write_log

QUICK = Options(draws=200)


def solved(policy, wins, count=60, **changes):
    """A policy's single trials: solved on the scenarios of `wins`."""
    return [trial_row(n, success=n in wins, policy=policy, **changes) for n in range(count)]


def study(tmp_path, *groups):
    return read_study([str(write_log(tmp_path / f"{n}.jsonl", rows)) for n, rows in enumerate(groups)])


def six(tmp_path, count=60):
    """Six policies; the first is ahead of the second on 14 scenarios and behind on 4: p 0.031 alone, not
    among 15."""
    wins = [
        set(range(40)),
        set(range(14, 44)),
        set(range(4)),
        set(range(3)),
        set(range(5)),
        set(range(50, 53)),
    ]
    return study(tmp_path, *(solved(f"p{k}", w, count) for k, w in enumerate(wins)))


@pytest.mark.parametrize("size", [3, 6, 9, 12])
def test_p_is_that_of_scipys_exact_permutation_test(size):
    rng = np.random.default_rng(size)
    for trials in (1, 3, 5):
        x = rng.integers(-trials, trials + 1, size) / trials
        expected = stats.permutation_test(
            (x,), lambda v, axis=-1: v.mean(axis=axis), permutation_type="samples", n_resamples=np.inf,
            alternative="two-sided", vectorized=True,
        )  # fmt: skip
        if x.any():
            assert sign_flip_p(x) == pytest.approx(float(expected.pvalue))


def test_p_of_few_scenarios_is_as_large_as_it_has_to_be():
    assert sign_flip_p(np.array([1.0, 1, 1])) == 0.25  # a bootstrap of three says 0.0002
    assert sign_flip_p(np.array([1.0, 1, 1, 1, 1, 1, 0])) == 2 / 2**6
    assert sign_flip_p(np.zeros(9)) == 1
    assert math.isnan(sign_flip_p(np.array([])))


def test_many_units_and_any_numbers_have_a_p():
    rng = np.random.default_rng(0)
    many = rng.choice([-1.0, 0, 1], 2000, p=[0.18, 0.6, 0.22])
    differ = many[many != 0]
    binomial = stats.binomtest(int((differ > 0).sum()), len(differ)).pvalue
    assert sign_flip_p(many) == pytest.approx(binomial)
    odd = rng.normal(0.3, 1, 40)
    assert sign_flip_p(odd) == pytest.approx(stats.ttest_1samp(odd, 0).pvalue, abs=0.02)
    assert _random_flips(np.ones(40)) == 1 / 10_000  # (b + 1) / (flips + 1)


def test_headline_dots_table_and_compare_follow_one_rule(tmp_path):
    results = analyse(six(tmp_path), QUICK)
    (close,) = [c for c in results.contrasts if (c.a, c.b) == ("p0", "p1")]
    assert close.p == pytest.approx(stats.binomtest(14, 18).pvalue)
    assert close.difference.low > 0, "alone, the interval leaves out zero"
    assert (close.verdict, close.family) == (ComparisonVerdict.NOT_SEPARATED, 15)
    assert "Not separated from p0 with these trials: p1 (50.0 %)." in headline(results)
    separate = sum(c.verdict.separated for c in results.contrasts)
    assert f"{separate} of 15 pairs are separated" in paired_differences(results).description
    table = paired_contrasts(results)
    row = dict(zip([c.title for c in table.columns], table.rows[0], strict=True))
    assert row["Verdict"] == "not separated"
    for c in results.contrasts:
        other = compare(results.study, c.a, c.b, QUICK)
        assert (other.contrast.p, other.contrast.p_holm) == (c.p, c.p_holm)
        assert other.decision is c.verdict
    assert compare(six(tmp_path), "p0", "p1", QUICK).verdict.startswith("Not separated once p is adjusted")


def test_interventions_are_a_family_of_their_own(tmp_path):
    """compare counted a reversion arm as a policy: the adjusted p of two policies changed with it."""
    base, other = solved("base", set(range(30))), solved("other", set(range(12)))
    back = solved("base", set(range(45)), start="reversion", rewind_steps=30)
    helped = solved("monitored", set(range(32)), interventions=[["rollback", 3]])
    options = Options(draws=200, baseline="base")
    results = analyse(study(tmp_path, base, other, back, helped), options)
    assert [(c.a, c.b, c.family) for c in results.contrasts] == [("base", "other", 1)]
    assert [(c.a, c.b, c.family) for c in results.procedure_contrasts] == [
        ("monitored", "base", 2), ("base, 30 steps back", "base", 2),
    ]  # fmt: skip
    same = compare(results.study, "base", "other", options)
    assert same.contrast.p_holm == same.contrast.p == results.contrasts[0].p_holm
    gain = compare(results.study, "base", "base, 30 steps back", options)
    assert gain.contrast.p_holm == results.procedure_contrasts[1].p_holm
    assert gain.verdict == "base, 30 steps back is better, by 25.0 points."
    table = interventions(results)
    verdicts = [row[[c.title for c in table.columns].index("Verdict")] for row in table.rows]
    assert verdicts == ["too few differ", "helps"]
    with pytest.raises(RowsError, match="other against monitored is no one question"):
        compare(results.study, "other", "monitored", options)


def test_a_policy_on_three_scenarios_wins_nothing(tmp_path):
    groups = [policy_rows(p, 60, 2, r, n) for n, (p, r) in enumerate([("a", 0.6), ("b", 0.4)])]
    lucky = [trial_row(n, k, policy="lucky") for n in range(3) for k in range(2)]
    results = analyse(study(tmp_path, *groups, lucky), QUICK)
    text = headline(results)
    assert text.startswith("Success of a: ")
    assert "not ranked, because not run on all of these: lucky" in text
    assert "lucky" not in forest(results).description.split("Not ranked")[0]
    assert "lucky" not in oracle_bars(results).description
    assert not any("lucky" in str(row[0]) for row in oracle_table(results).rows)
    of_lucky = [c for c in results.contrasts if "lucky" in (c.a, c.b)]
    assert {c.verdict for c in of_lucky} == {ComparisonVerdict.INCOMPLETE}
    assert all(math.isnan(c.p_holm) for c in of_lucky)
    assert next(c.family for c in results.contrasts if c.complete) == 1
    found = compare(results.study, "a", "lucky", QUICK)
    assert found.verdict.startswith("No verdict: one of the two was not run on all the scenarios")
    assert "not adjusted" in to_screen(found)
    assert any("lucky (3 of 60)" in r for r in results.remarks)


def test_a_macro_over_fewer_cells_is_not_printed_as_one(tmp_path):
    whole, part = policy_rows("a", 40, 2, 0.5, 0), policy_rows("b", 40, 2, 0.5, 1)
    results = analyse(study(tmp_path, whole, [r for r in part if r.stage == "Approach"]), QUICK)
    table = overall(results)
    columns = [c.title for c in table.columns]
    a, b = (dict(zip(columns, row, strict=True)) for row in table.rows)
    assert not math.isnan(a["Macro-4 %"].value)
    assert math.isnan(b["Macro-4 %"].value)
    for row in (a, b):  # four cells are not the paper's nine
        assert math.isnan(row["Macro-9 %"].value)
        assert math.isnan(row["Macro-9 % (percentile bootstrap, as in the paper)"].value)


def test_scheduled_scenarios_without_any_row_count_as_failures(tmp_path):
    few = [trial_row(n, k, policy="few") for n in range(3) for k in range(2)]
    results = analyse(study(tmp_path, policy_rows("a", 30, 2, 0.5, 0), few), Options(draws=200, scheduled=2))
    assert results.compared.complete
    few_rate = results.ranked_rates[results.ranked.arms.index("few")]
    assert few_rate.value == pytest.approx(3 / 30)


def test_the_common_scenarios_when_asked_for(tmp_path):
    runs = [policy_rows(p, n, 2, 0.5, 0) for p, n in (("a", 40), ("b", 40), ("c", 10))]
    whole = analyse(study(tmp_path, *runs), QUICK)
    assert (whole.ranked.arms, len(whole.ranked.scenarios)) == (("a", "b"), 40)
    common = analyse(whole.study, Options(draws=200, common=True))
    assert (common.ranked.arms, len(common.ranked.scenarios)) == (("a", "b", "c"), 10)
    assert "Ranked on the 10 of 40 scenarios" in headline(common)
    with pytest.raises(RowsError, match="no scenario was run by all"):
        analyse(
            study(tmp_path, runs[2], policy_rows("d", 40, 2, 0.5, 0)[40:]), Options(draws=200, common=True)
        )


def test_the_largest_complete_table():
    run = np.ones((4, 60), bool)
    run[3, 3:] = False
    assert compared(run, tuple("abcd")).policies == (0, 1, 2)
    run[2] = True
    run[1, 59] = run[0, 58] = False  # two lack one scenario each: 58 are common to three
    found = compared(run, tuple("abcd"))
    assert (found.policies, len(found.scenarios), found.complete) == ((0, 1, 2), 58, False)
    assert "d (3 of 60)" in found.words
    assert compared(run, tuple("abcd"), common=True).policies == (0, 1, 2, 3)
    assert compared(np.ones((2, 5), bool), tuple("ab")).words == ""


def test_five_differing_scenarios_are_no_verdict_and_six_may_be(tmp_path):
    for differing, expected in ((5, ComparisonVerdict.TOO_FEW), (6, ComparisonVerdict.A_BETTER)):
        both = study(
            tmp_path / str(differing), solved("a", set(range(20))), solved("b", set(range(differing, 20)))
        )
        results = analyse(both, QUICK)
        assert results.contrasts[0].verdict is expected
        if expected is ComparisonVerdict.TOO_FEW:
            assert results.contrasts[0].difference.high > 0
            said = "No verdict against b: fewer than 6 scenarios differ, too few for any test."
            assert said in headline(results)


def test_headline_of_two(tmp_path):
    results = analyse(study(tmp_path, solved("a", set(range(50))), solved("b", set(range(9)))), QUICK)
    assert headline(results).endswith(" a is separated from the other policy.")


def test_a_bound_that_rounding_made_decides_nothing(tmp_path):
    """Rates in thirds and fifths: the sums of their differences are zero but for the last bits."""
    results = analyse(six(tmp_path), QUICK)
    for c in results.contrasts:
        for bound in (c.difference.low, c.difference.high):
            assert bound == 0 or abs(bound) > 1e-12
    a = np.array([1 / 3, 2 / 3, 0.2, 0.8] * 15)
    b = a.reshape(-1, 4)[:, [1, 0, 3, 2]].ravel()
    assert sign_flip_p(a - b) == 1
    percentile = results.draws.percentile((a - b)[:, None] * 1e-16)[0]
    assert (percentile.low, percentile.high) == (0, 0)


def test_a_log_of_another_set_does_not_take_the_board(tmp_path):
    for n, (policy, rate) in enumerate([("strong", 0.9), ("weak", 0.1), ("mid", 0.5)]):
        write_log(tmp_path / f"{policy}.jsonl", policy_rows(policy, 30, 2, rate, n))
    write_log(tmp_path / "more.jsonl", [*policy_rows("more", 30, 2, 0.6, 3), trial_row(77, policy="more")])
    changed = [replace(r, scenario_sha256="f" * 64) for r in policy_rows("changed", 30, 2, 0.6, 3)]
    write_log(tmp_path / "changed.jsonl", changed)
    write_log(tmp_path / "part.jsonl", policy_rows("part", 8, 2, 1.0, 3))
    found = make_leaderboard(tmp_path, QUICK)
    assert sorted(sorted(e.policy for e in board.entries) for board in found.boards) == [
        ["changed"], ["mid", "part", "strong", "weak"], ["more"],
    ]  # fmt: skip
    (board,) = [b for b in found.boards if len(b.entries) == 4]
    assert ranks(board) == ["1", "2", "3", ""]
    assert [e.policy for e in board.entries if separated(e)] == ["mid", "weak"]
    sets = {b.scenario_set for b in found.boards}
    assert len(sets) == 3
    assert board.scenario_set in board_table(board).title
    assert found.refused == ()


def test_the_board_does_not_separate_what_holm_does_not(tmp_path):
    six(tmp_path / "logs")
    (board,) = make_leaderboard(tmp_path / "logs", QUICK).boards
    best, second = board.entries[:2]
    assert (best.policy, second.policy) == ("p0", "p1")
    assert second.behind.low > 0
    assert not separated(second)
    assert ranks(board)[:3] == ["1 to 2", "1 to 2", "3 to 6"]
    assert [row[4] for row in board_table(board).rows][:3] == [
        "best",
        "not separated from it",
        "behind the best",
    ]


@pytest.mark.nightly
@pytest.mark.slow
def test_commands_say_the_same(tmp_path, capsys):
    six(tmp_path)
    logs = sorted(str(p) for p in tmp_path.glob("*.jsonl"))
    assert main(["report", *logs, f"--out={tmp_path / 'out'}", "--draws=200"]) == 0
    said = json.loads((tmp_path / "out" / "results.json").read_text())
    assert capsys.readouterr().out.startswith(said["headline"])
    assert re.search(
        r"over 60 scenarios\)\. Recovery in other tasks than these 10: [\d.]+ to [\d.]+ %\.",
        said["headline"],
    )
    table = said["tables"]["contrasts"]
    column = [c["title"] for c in table["columns"]].index("p (Holm)")
    assert main(["compare", *logs, "--a=p0", "--b=p1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["contrast"]["p_holm"] == table["rows"][0][column]
