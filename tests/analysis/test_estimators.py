"""Estimators of the report, against hand-worked tables, scipy, and each other."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from lerobot_roborecover.analysis.stats.arms import Arm
from lerobot_roborecover.analysis.stats.contrasts import contrasts, contributions
from lerobot_roborecover.analysis.stats.costs import intervention_cost
from lerobot_roborecover.analysis.stats.crossfit import oracle, profile_difference
from lerobot_roborecover.analysis.stats.estimators import RowsError, macro, rsr, scenario_rates
from lerobot_roborecover.analysis.stats.groups import group_rates, own_arm, source_matrix
from lerobot_roborecover.analysis.stats.macro import macro_estimates, percentile_macro
from lerobot_roborecover.analysis.stats.monitor import METRICS, metric_columns
from lerobot_roborecover.analysis.stats.panel import make_panel
from lerobot_roborecover.analysis.stats.ranking import StartRates, rank_agreement
from lerobot_roborecover.analysis.stats.resampling import masked_mean, resample
from lerobot_roborecover.analysis.stats.timing import budget_estimates, median_steps, rates_within
from lerobot_roborecover.analysis.stats.variance import variance_split
from lerobot_roborecover.logs.trial_log import TrialLogError
from lerobot_roborecover.scenario import Start
from tests.support.bootstrap import bootstrap_interval
from tests.support.trial_rows import policy_rows, trial_row


def arm(rows, name=None, start=Start.RECOVERY):
    return Arm(name or rows[0].policy, start, 0, tuple(rows))


def panel_of(*groups, **kwargs):
    return make_panel([arm(rows) for rows in groups], **kwargs)


def panel_from(table, names="abcdef", **changes):
    """A panel from {scenario number: [successes of each arm as a string of 0 and 1]}."""
    groups = []
    for p in range(len(next(iter(table.values())))):
        groups.append(
            [
                trial_row(s, k, mark == "1", policy=names[p], **changes)
                for s, marks in table.items()
                for k, mark in enumerate(marks[p])
            ]
        )
    return panel_of(*groups)


def draws_of(panel):
    return resample(panel.units())


TABLE = {0: ("11", "1000"), 1: ("10", "1111"), 2: ("00", "11"), 3: ("1", "0")}


def test_unequal_trial_counts_by_hand():
    panel = panel_from(TABLE)
    np.testing.assert_array_equal(panel.rates, [[1, 0.5, 0, 1], [0.25, 1, 1, 0]])
    assert masked_mean(panel.rates.T).tolist() == [0.625, 0.5625]  # pooled trials would say 4/7 and 7/11


def test_panel_agrees_with_the_row_estimators_of_the_demo():
    rows = policy_rows("alpha@1", 40, 5, 0.5, 3)
    panel = panel_of(rows)
    rates = scenario_rates([asdict(r) for r in rows])
    np.testing.assert_array_equal(panel.rates[0], rates.rates)
    (estimate,) = draws_of(panel).percentile(panel.rates.T)
    assert estimate.value == pytest.approx(rsr(rates.rates))
    assert (estimate.low, estimate.high) == pytest.approx(bootstrap_interval(rates.rates))
    (macro_estimate,) = percentile_macro(panel, draws_of(panel))
    assert macro_estimate.value == pytest.approx(macro(rates.rates, rates.cells))
    assert macro_estimates(panel, draws_of(panel))[0].value == pytest.approx(macro_estimate.value)
    expected = bootstrap_interval(rates.rates, rates.cells)
    assert (macro_estimate.low, macro_estimate.high) == pytest.approx(expected)


def test_invalid_trials_count_as_failures_and_can_be_left_out():
    rows = [trial_row(0, 0), trial_row(0, 1, outcome="sim_error"), trial_row(1, 0, outcome="state_mismatch")]
    panel = panel_of(rows)
    np.testing.assert_array_equal(panel.rates, [[0.5, 0]])
    np.testing.assert_array_equal(panel.valid_rates, [[1, np.nan]])
    assert masked_mean(panel.valid_rates.T).tolist() == [1.0]


def test_scheduled_trials_without_a_row_are_failures():
    panel = panel_of([trial_row(0, 0), trial_row(0, 1), trial_row(1, 0)], scheduled=2)
    np.testing.assert_array_equal(panel.rates, [[1, 0.5]])
    with pytest.raises(RowsError, match="has 2 trials of s000; 1 were scheduled"):
        panel_of([trial_row(0, 0), trial_row(0, 1)], scheduled=1)


def test_robotwin_resamples_clusters_and_the_others_scenarios():
    rows = [trial_row(n, cluster=f"c{n // 2}") for n in range(4)]
    assert len(set(panel_of(rows).units())) == 4
    assert len(set(panel_of([replace(r, platform="robotwin") for r in rows]).units())) == 2


def test_a_draw_without_any_value_is_left_out():
    values = np.array([[0.2], [np.nan], [np.nan], [0.8]])
    draws = resample(list("abcd"))
    means = draws.means(values)[:, 0]
    assert np.isnan(means).mean() == pytest.approx(1 / 16, abs=0.02)  # (2/4)^4: neither a nor d is drawn
    (estimate,) = draws.percentile(values)
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((0.5, 0.2, 0.8))


def test_one_unit_or_one_value_has_no_interval():
    for kind in ("rates", "differences", "percentile"):
        (single,) = getattr(resample(["a"]), kind)(np.array([[0.4]]))
        assert single.value == 0.4
        assert math.isnan(single.low)
        (cluster,) = getattr(resample(["a", "a"]), kind)(np.array([[0.4], [0.6]]))
        assert math.isnan(cluster.high)
        (lonely,) = getattr(resample(list("ab")), kind)(np.array([[0.4], [np.nan]]))
        assert math.isnan(lonely.low)


def test_contrast_agrees_with_scipy():
    rng = np.random.default_rng(0)
    rates = rng.integers(0, 6, (2, 80)) / 5
    (found,) = contrasts(rates, "ab", resample([f"{i:02d}" for i in range(80)]))
    t = stats.ttest_rel(*rates)
    expected = t.confidence_interval()
    assert found.difference.value == pytest.approx((rates[0] - rates[1]).mean())
    assert found.difference.low == pytest.approx(expected.low, abs=0.006)
    assert found.difference.high == pytest.approx(expected.high, abs=0.006)
    assert found.p == pytest.approx(t.pvalue, abs=0.05)


def test_a_paired_interval_is_narrower_than_two_apart():
    difficulty = np.random.default_rng(2).uniform(0, 0.8, 100)
    (found,) = contrasts(
        np.stack([difficulty + 0.1, difficulty]), "ab", resample([f"{i:03d}" for i in range(100)])
    )
    (apart,) = resample([f"{i:03d}" for i in range(100)]).differences(
        np.stack([difficulty + 0.1 - np.random.default_rng(3).permutation(difficulty)], 1)
    )
    assert found.difference.value == pytest.approx(0.1)
    assert found.difference.high - found.difference.low < 0.4 * (apart.high - apart.low)
    assert found.p == pytest.approx(2 * 0.5**100)


def test_equal_policies_are_not_separated():
    rates = np.tile(np.linspace(0, 1, 30), (2, 1))
    (found,) = contrasts(rates, "ab", resample([f"{i:02d}" for i in range(30)]))
    assert (found.difference.value, found.p, found.p_holm) == (0, 1, 1)


def test_holm_by_hand():
    rng = np.random.default_rng(4)
    rates = rng.binomial(5, [[0.3], [0.4], [0.45]], (3, 60)) / 5
    found = contrasts(rates, "abc", resample([f"{i:02d}" for i in range(60)]))
    assert [(c.a, c.b) for c in found] == [("a", "b"), ("a", "c"), ("b", "c")]
    order = sorted(found, key=lambda c: c.p)
    running = 0.0
    for factor, contrast in zip((3, 2, 1), order, strict=True):
        running = max(running, min(1.0, factor * contrast.p))
        assert contrast.p_holm == pytest.approx(running)


def test_contrasts_use_common_scenarios_only():
    rates = np.array([[1.0, 1.0, np.nan, 0.0], [0.0, np.nan, 1.0, 0.5]])
    (found,) = contrasts(rates, "ab", resample(list("wxyz")))
    assert (found.scenarios, found.difference.value) == (2, 0.25)
    (none,) = contrasts(np.array([[1.0, np.nan], [np.nan, 1.0]]), "ab", resample(list("wx")))
    assert none.scenarios == 0
    assert math.isnan(none.difference.value)
    assert math.isnan(none.p_holm)


def test_contributions_add_up_to_the_difference():
    a, b = np.array([1, 0.5, 0.25, np.nan]), np.array([0.5, 0.5, 0.75, 1])
    shares = contributions(a, b, np.array(["x", "x", "y", "y"]))
    assert [(s.group, s.scenarios) for s in shares] == [("x", 2), ("y", 1)]
    assert [s.difference for s in shares] == [0.25, -0.5]
    assert sum(s.contribution for s in shares) == pytest.approx(0)
    with pytest.raises(RowsError, match="no scenario in common"):
        contributions(np.array([np.nan]), np.array([1.0]), np.array(["x"]))


def test_profile_difference_by_hand():
    panel = panel_from({0: ("11111", "00000"), 1: ("00000", "11111"), 2: ("11000", "00110")})
    found = profile_difference(panel, 0, 1, draws_of(panel))
    assert (found.hindsight, found.higher, found.lower, found.equal) == (pytest.approx(2 / 3), 1, 1, 1)
    # The first two are as far apart in either half; of the third, level, chance makes no sign that holds.
    assert found.difference.value == pytest.approx(2 / 3, abs=0.08)
    assert found.floor.value < found.hindsight


def agreement(initial, recovery, names, units):
    """Of policies whose scenarios have a first state each."""
    return rank_agreement(
        *(StartRates(tuple(names), rates, resample(units)) for rates in (initial, recovery))
    )


def test_rank_bounds_follow_from_what_is_separated_from_both_starts():
    """a above b from both starts, c and d the other way round, and nothing sure of the rest."""
    rng = np.random.default_rng(0)
    names, rates = "abcd", {"initial": (0.95, 0.05, 0.9, 0.1), "recovery": (0.95, 0.05, 0.1, 0.9)}
    initial, recovery = (rng.binomial(5, np.array(r)[:, None], (4, 60)) / 5 for r in rates.values())
    found = agreement(initial, recovery, names, [f"{i:02d}" for i in range(60)])
    assert found.shown_same >= 1
    assert found.shown_inverted >= 1
    assert (found.inversions.low, found.inversions.high) == (found.shown_inverted, 6 - found.shown_same)
    assert found.inversions.low <= found.inversions.value <= found.inversions.high
    assert found.tau.low <= found.tau.value <= found.tau.high + 1e-9


def test_rank_inversions_by_hand():
    initial = np.array([[0.9, 0.9], [0.8, 0.8], [0.7, 0.7], [0.7, 0.7]])
    recovery = np.array([[0.1, 0.1], [0.5, 0.5], [0.3, 0.3], [0.2, 0.2]])
    found = agreement(initial, recovery, "abcd", list("xy"))
    assert found.inversions.value == 3
    assert (found.inversions.low, found.inversions.high) == (0, 6)  # two scenarios show nothing
    assert found.inverted == (("a", "b"), ("a", "c"), ("a", "d"))  # c and d tie initially
    assert found.tau.value == pytest.approx(stats.kendalltau([4, 3, 2, 2], [1, 4, 3, 2]).statistic)


def test_one_policy_has_no_rank_agreement():
    found = agreement(np.ones((1, 3)), np.ones((1, 3)), "a", list("xyz"))
    assert found.inversions.value == 0
    assert math.isnan(found.rho)
    assert math.isnan(found.tau.low)


def test_groups_and_their_mark():
    panel = panel_from({n: ("1" if n % 4 == 0 else "0",) for n in range(42)})
    cells = group_rates(panel, "cell", draws_of(panel))
    assert [(g.label, g.scenarios) for g in cells] == [
        ("Approach-Wrong Target", 11), ("Approach-Wrong Pose", 11), ("Contact-Wrong Pose", 10),
        ("Place-Scene Change", 10),
    ]  # fmt: skip
    assert [g.estimates[0].value for g in cells] == [0, 1, 0, 0]
    few = panel_from(dict.fromkeys(range(36), ("1",)))
    assert all(g.underpowered for g in group_rates(few, "cell", draws_of(few)))


def test_retention_by_hand():
    recovery = np.array([[0.5, 0.25, 1.0, np.nan]])
    initial = np.array([[1.0, 0.5, np.nan, 1.0]])
    (estimate,) = resample(list("wxyz")).ratios(recovery.T, initial.T)
    assert estimate.value == pytest.approx(0.75 / 1.5)
    assert math.isnan(estimate.low)  # two scenarios leave the lower rate at zero
    (never,) = resample(list("wx")).ratios(np.full((2, 1), 0.5), np.zeros((2, 1)))
    assert math.isnan(never.value)
    many = [str(n) for n in range(40)]
    (known,) = resample(many).ratios(np.tile(recovery[:, :2], 20).T, np.tile(initial[:, :2], 20).T)
    assert known.value == pytest.approx(0.5)
    assert 0.35 < known.low < 0.5 < known.high < 0.65


def test_oracle_by_hand():
    panel = panel_from({0: ("11", "00"), 1: ("10", "11"), 2: ("00", "00"), 3: ("01", "01")})
    found = oracle(panel, draws_of(panel))
    assert found.hindsight.value == pytest.approx((1 + 1 + 0 + 0.5) / 4)
    assert (found.best_policy, found.best_rate.value) == ("a", 0.5)
    assert found.hindsight_gain.value == pytest.approx(0.125)
    assert found.rate.value < found.hindsight.value
    assert found.gain.value == pytest.approx(found.rate.value - found.fixed.value)
    assert found.no_success == ("s002",)


def test_source_matrix_by_hand():
    # Natural scenarios are 0, 1, 3, 4 (index % 3 != 2); alpha drove the even ones, beta the odd ones.
    marks = {
        0: ("00", "11", "10"), 1: ("11", "00", "10"), 2: ("11", "11", "11"), 3: ("10", "00", "11"),
        4: ("10", "11", "00"),
    }  # fmt: skip
    panel = panel_from(marks, names=["runs/alpha@77", "gamma", "Beta@3"])
    rows = {row.source_policy: row for row in source_matrix(panel, draws_of(panel))}
    alpha, beta = rows["alpha"], rows["beta"]
    assert [e.value for e in alpha.rates] == [0.25, 1.0, 0.25]
    assert (alpha.own, alpha.best_other, alpha.hindsight_gain) == (0, 1, 0.75)
    assert alpha.gain.value == pytest.approx(0.75)  # gamma is the better one in either half
    assert [e.value for e in beta.rates] == [0.75, 0.0, 0.75]
    assert (beta.own, beta.best_other, beta.hindsight_gain) == (2, 0, 0.0)


def test_own_arm_is_never_guessed():
    assert own_arm("pi05", ["lerobot/pi05@abc", "pi0@1"]) == 0
    assert own_arm("pi05", ["pi05_libero@abc"]) is None
    assert own_arm("pi05", ["pi05@a", "pi05@b"]) is None


def test_variance_split_finds_the_components():
    rng = np.random.default_rng(8)
    n, k = 4000, 5
    rates = np.clip(rng.beta(2, 2, n), 0, 1)
    found = variance_split(rng.binomial(k, rates), np.full(n, k))
    assert found.between == pytest.approx(rates.var(), rel=0.07)
    assert found.within == pytest.approx((rates * (1 - rates)).mean(), rel=0.03)
    assert found.standard_error == pytest.approx(math.sqrt((found.between + found.within / k) / n), rel=1e-3)
    assert found.same_cost_scenarios < found.one_more_trial < found.standard_error


def test_variance_split_says_when_it_cannot_tell():
    single = variance_split(np.array([1, 0, 1, 0]), np.ones(4, int))
    assert math.isnan(single.between)
    assert math.isnan(single.one_more_trial)
    assert single.one_more_scenario < single.standard_error
    alone = variance_split(np.array([2]), np.array([5]))
    assert math.isnan(alone.standard_error)
    assert variance_split(np.array([0]), np.array([0])).scenarios == 0
    certain = variance_split(np.array([5, 5]), np.array([5, 5]))
    assert (certain.between, certain.within, certain.standard_error) == (0, 0, 0)


def test_time_to_recover_by_hand():
    rows = [
        trial_row(0, 0, steps=30), trial_row(0, 1, steps=160), trial_row(0, 2, False, steps=300),
        trial_row(1, 0, steps=300), trial_row(1, 1, outcome="sim_error", steps=10),
    ]  # fmt: skip
    panel = panel_of(rows)
    found = rates_within(panel, [0.1, 0.5, 1.0])
    np.testing.assert_allclose(found[0], [[1 / 3, 1 / 3, 2 / 3], [0, 0, 0.5]])
    by_steps = rates_within(panel, [29, 30, 160], of_horizon=False)
    np.testing.assert_allclose(by_steps[0, 0], [0, 1 / 3, 2 / 3])
    np.testing.assert_allclose(found[..., -1], panel.rates)
    assert median_steps(panel) == [160]
    assert budget_estimates(panel, [1.0], draws_of(panel))[0][0].value == pytest.approx((2 / 3 + 0.5) / 2)


def test_intervention_cost_by_hand():
    rollback = [["rollback", 12]]
    direct = [
        trial_row(0, 0, steps=50),
        trial_row(0, 1, False, steps=300),
        trial_row(1, 0, steps=60),
        trial_row(2, 0),
    ]
    acted = [
        trial_row(0, 0, False, steps=300, policy="x", interventions=rollback),
        trial_row(0, 1, True, steps=100, policy="x", interventions=[*rollback, {"kind": "monitor", "step":
        12, "calls": 9}]), trial_row(1, 0, True, steps=80, policy="x", interventions=[{"kind": "monitor",
        "step": 80, "calls": 80}]),
    ]  # fmt: skip
    panel = panel_of(direct, acted)
    found = intervention_cost(panel, 0, 1, draws_of(panel))
    assert (found.scenarios, found.matched, found.rescued, found.harmed) == (2, 3, 1, 1)
    assert (found.direct.value, found.with_intervention.value, found.gain.value) == (0.75, 0.75, 0.0)
    assert found.extra_steps.value == pytest.approx(((200 - 175) + 20) / 2)
    assert found.triggered.value == pytest.approx(0.5)
    assert found.per_trial == {"monitor calls": pytest.approx(89 / 3), "rollback": pytest.approx(2 / 3)}
    with pytest.raises(TrialLogError, match="intervention 7 is neither"):
        intervention_cost(
            panel_of(direct, [trial_row(0, 0, policy="x", interventions=[7])]), 0, 1, draws_of(panel)
        )


def test_monitor_metrics_by_hand():
    counts = np.array([[8.0, 2.0, 1.0, 9.0], [0.0, 0.0, 1.0, 1.0]])  # TN, FP, FN, TP
    found, none_before = (dict(zip(METRICS, row, strict=True)) for row in metric_columns(counts))
    assert found["accuracy"] == 0.85
    assert (found["precision"], found["recall"]) == (9 / 11, 0.9)
    assert found["f1"] == pytest.approx(18 / 21)
    assert found["macro_f1"] == pytest.approx((18 / 21 + 16 / 19) / 2)
    assert found["false_positive_rate"] == 0.2
    assert math.isnan(none_before["false_positive_rate"])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.permutations(range(28)))
def test_the_order_of_rows_changes_no_estimate(seed, order):
    rows = policy_rows("alpha@1", 28, 3, 0.5, seed)  # seven scenarios a cell: the least that Macro takes
    shuffled = [r for s in order for r in rows if r.scenario_id == f"s{s:03d}"][::-1]
    first, second = panel_of(rows), panel_of(shuffled)
    assert draws_of(first).rates(first.rates.T) == draws_of(second).rates(second.rates.T)
    assert macro_estimates(first, draws_of(first)) == macro_estimates(second, draws_of(second))
