"""No verdict rests on trial counts that depend on outcomes, nor on arms without a valid trial."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.compare import compare
from lerobot_roborecover.analysis.headline import headline
from lerobot_roborecover.analysis.leaderboard import make_leaderboard
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.pages.leaderboard import board_table
from lerobot_roborecover.analysis.report_tables import all_tables
from lerobot_roborecover.analysis.stats.soundness import counts_depend_on_outcomes
from lerobot_roborecover.analysis.stats.verdicts import ComparisonVerdict
from tests.support.trial_rows import policy_rows, trial_row, write_log

QUICK = Options(draws=200)


def retried(policy, count=60, most=5, rate=0.5, seed=0):
    """Trials of every scenario until its first success."""
    rng, rows = np.random.default_rng(seed), []
    for scenario in range(count):
        for k in range(most):
            rows.append(trial_row(scenario, k, bool(rng.random() < rate), policy=policy))
            if rows[-1].success:
                break
    return rows


def logs_of(folder, **groups):
    return [str(write_log(folder / f"{name}.jsonl", rows)) for name, rows in groups.items()]


def study_of(folder, **groups):
    return read_study(logs_of(folder, **groups))


@pytest.mark.parametrize("most", [2, 5, 20])
def test_a_retry_until_success_is_not_better_than_its_equal(tmp_path, most):
    """Nothing differs between the two; mean rates of scenarios that stop at their success are too high."""
    study = study_of(tmp_path, a=retried("a", most=most), b=policy_rows("b", 60, 3, 0.5, 1))
    results = analyse(study, QUICK)
    contrast = results.contrast("a", "b")
    assert contrast.verdict is ComparisonVerdict.COUNTS_DEPEND
    assert (contrast.family, contrast.complete) == (0, False)
    assert "Evaluate every scenario the same number of times" in compare(study, options=QUICK).verdict
    assert any(r.startswith("a: its trial counts go with its outcomes") for r in results.remarks)
    text = headline(results)
    assert "separated" not in text
    assert "trial counts go with" in text


def test_retries_are_seen_in_every_log():
    """They reached "better" in 74 % of such logs."""
    logs = [retried("a", seed=seed) for seed in range(20)]
    outcomes = [
        [[r.success for r in rows if r.scenario_id == f"s{n:03d}"] for n in range(60)] for rows in logs
    ]
    assert all(counts_depend_on_outcomes(each) for each in outcomes)


def test_a_leaderboard_has_no_standing_for_retries(tmp_path):
    logs_of(tmp_path, a=retried("a", rate=0.1), b=policy_rows("b", 60, 3, 0.9, 1))
    (board,) = make_leaderboard(tmp_path, QUICK).boards
    table = board_table(board)
    standing = {row[0]: row[[c.title for c in table.columns].index("Standing")] for row in table.rows}
    assert standing["a"] == "no verdict: trial counts depend on outcomes"


def test_an_incomplete_run_is_none_of_that(tmp_path):
    """A run that ended early lacks trials of its last scenarios, whatever came out."""
    rng = np.random.default_rng(0)
    flagged = 0
    for _ in range(40):
        outcomes = rng.random((60, 5)) < rng.random((60, 1))
        rows = [list(o[: 5 if n < 40 else 2]) for n, o in enumerate(outcomes)]
        flagged += counts_depend_on_outcomes(rows)
    assert flagged <= 1
    assert not counts_depend_on_outcomes([[True] * 5] * 20), "equal counts"
    part = [r for r in policy_rows("a", 60, 5, 0.9, 0) if r.trial < 2 or int(r.scenario_id[1:]) < 40]
    results = analyse(study_of(tmp_path, a=part, b=policy_rows("b", 60, 5, 0.2, 1)), QUICK)
    assert results.contrast("a", "b").verdict is ComparisonVerdict.A_BETTER


@pytest.mark.parametrize("repeat", ["failures", "successes"])
def test_more_trials_where_the_first_failed_or_succeeded(repeat):
    """Two trials of each scenario, five where both failed, or where both succeeded."""
    rng = np.random.default_rng(0)
    outcomes = rng.random((80, 5)) < 0.5
    more = ~outcomes[:, :2].any(1) if repeat == "failures" else outcomes[:, :2].all(1)
    assert counts_depend_on_outcomes([list(o[: 5 if m else 2]) for o, m in zip(outcomes, more, strict=True)])


def mismatched(policy, count=20):
    return [
        trial_row(n, k, outcome="state_mismatch", policy=policy, steps=0)
        for n in range(count)
        for k in range(2)
    ]


def test_a_log_without_a_valid_trial_has_no_rate_in_its_headline(tmp_path):
    results = analyse(study_of(tmp_path, a=mismatched("a")), QUICK)
    text = headline(results)
    assert text.startswith("No trial was valid (40 state_mismatch): the rebuilt recovery points are not")
    assert "roborecover doctor" in text
    assert "0.0 %" not in text


def test_a_policy_without_a_valid_trial_is_not_worse(tmp_path):
    study = study_of(tmp_path, a=mismatched("a"), b=policy_rows("b", 20, 2, 0.9, 0))
    results = analyse(study, QUICK)
    assert results.contrast("a", "b").verdict is ComparisonVerdict.NO_VALID_TRIAL
    text = headline(results)
    assert text.startswith("Success of b:")
    assert "No trial of a was valid (40 state_mismatch)" in text
    assert "separated" not in text
    never = [trial_row(n, k, False, policy="c") for n in range(20) for k in range(2)]
    results = analyse(study_of(tmp_path / "never", a=mismatched("a"), c=never), QUICK)
    assert headline(results).startswith("Success of c: 0.0 % from recovery points"), "its trials are valid"


def test_the_notes_say_what_sign_flips_test(tmp_path):
    rows = {p: policy_rows(p, 20, 2, 0.5, n) for n, p in enumerate("ab")}
    tables = {t.name: t for t in all_tables(analyse(study_of(tmp_path, **rows), QUICK))}
    assert "as likely to have either sign, not whether their mean is zero" in tables["contrasts"].notes[0]
