"""The paper's tables agree with each other when our estimators work them out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from lerobot_roborecover.analysis import published
from lerobot_roborecover.analysis.stats.estimators import macro, rsr
from lerobot_roborecover.analysis.stats.monitor import METRICS, metric_columns
from lerobot_roborecover.analysis.stats.ranking import inverted_pairs

POLICIES = [(p.platform, p.policy) for p in published.policies()]

ORACLE = {"robotwin": (0.9563, 0), "libero": (0.9180, 1)}
"""Retrospective oracle and number of scenarios that no policy solved, as the appendix states them."""
LIBERO_TRIALS = 5
"""Trials per LIBERO scenario: its cell rates are multiples of 1 / (5 n), published to 0.1 point."""


def cell_counts(platform: str) -> dict[str, int]:
    """Scenarios of each cell of a platform's test set."""
    return {
        f"{row['stage']}-{row['deviation_type']}": int(row[f"{platform}_test"])
        for row in published.table("stage_type_counts")
    }


def cell_rates(platform: str, policy: str) -> dict[str, float]:
    """Rate of a policy in every cell, in [0, 1].

    LIBERO's are published to 0.1 point but are multiples of 1 / (5 n), which brings the missing digits back.
    """
    counts = cell_counts(platform)
    rates = {
        f"{row['stage']}-{row['deviation_type']}": float(row["rsr"]) / 100
        for row in published.table("stage_type_rates")
        if (row["platform"], row["policy"]) == (platform, policy)
    }
    if platform != "libero":
        return rates
    return {cell: _unrounded(rate, LIBERO_TRIALS * counts[cell]) for cell, rate in rates.items()}


def _unrounded(rate: float, trials: int) -> float:
    """The multiple of 1 / trials that rounds to the published rate; the rate itself where none does."""
    exact = round(rate * trials) / trials
    return exact if abs(exact - rate) <= 0.0005 + 1e-9 else rate


def overall_from_cells(platform: str, policy: str) -> tuple[float, float]:
    """Overall RSR and Macro-9 of a policy, worked out from its published cells with our own estimators."""
    counts, rates = cell_counts(platform), cell_rates(platform, policy)
    cells = np.repeat(list(counts), list(counts.values()))
    values = np.array([rates[cell] for cell in cells])
    return rsr(values), macro(values, cells)


def overall_from_groups(axis: str, policy: str) -> float:
    """Overall RSR on LIBERO from the published rates by `construction_source` or by `suite`."""
    rows = [row for row in published.table("libero_groups") if (row["axis"], row["policy"]) == (axis, policy)]
    counts = np.array([int(row["n"]) for row in rows])
    rates = [_unrounded(float(r["rsr"]) / 100, LIBERO_TRIALS * n) for r, n in zip(rows, counts, strict=True)]
    return float(counts @ np.array(rates) / counts.sum())


def source_rows(platform: str) -> dict[str, dict[str, float]]:
    """Source × recovery matrix: rates in [0, 1] by source policy, then by recovery policy."""
    rows: dict[str, dict[str, float]] = {}
    for row in published.table("source_matrix"):
        if row["platform"] == platform:
            rows.setdefault(row["source_policy"], {})[row["recovery_policy"]] = float(row["rsr"]) / 100
    return rows


def rows_of(platform):
    return published.policies(platform)


@pytest.mark.parametrize("name", published.TABLES)
def test_every_table_is_shipped(name):
    assert published.table(name)


def test_an_unknown_table_is_refused():
    with pytest.raises(ValueError, match="no published table 'results'; there are contrasts"):
        published.table("results")


def test_twelve_rows():
    assert len(POLICIES) == 12
    pi05 = next(p for p in rows_of("libero") if p.policy == "pi05")
    assert (pi05.rsr.value, pi05.rsr.low, pi05.rsr.high) == pytest.approx((0.644, 0.592, 0.695))
    assert pi05.libero_plus == pytest.approx(0.857)
    assert next(p for p in rows_of("robotwin") if p.policy == "pi05").libero_plus is None
    assert next(p for p in rows_of("robotwin") if p.policy == "X-VLA").libero_plus == pytest.approx(0.714)
    unifolm = next(p for p in rows_of("libero") if p.policy == "UnifoLM")
    assert (unifolm.libero_plus, unifolm.libero_plus_note) == (None, "none published")


@pytest.mark.parametrize(("platform", "policy"), POLICIES)
def test_overall_and_macro_follow_from_the_cells(platform, policy):
    row = next(p for p in rows_of(platform) if p.policy == policy)
    overall, macro9 = overall_from_cells(platform, policy)
    assert 100 * overall == pytest.approx(100 * row.rsr.value, abs=0.02)
    assert 100 * macro9 == pytest.approx(100 * row.macro9, abs=0.02)


@pytest.mark.parametrize("axis", ["construction_source", "suite"])
@pytest.mark.parametrize("policy", [p for platform, p in POLICIES if platform == "libero"])
def test_libero_overall_follows_from_sources_and_suites(axis, policy):
    row = next(p for p in rows_of("libero") if p.policy == policy)
    assert 100 * overall_from_groups(axis, policy) == pytest.approx(100 * row.rsr.value, abs=0.02)


@pytest.mark.parametrize("policy", [p for platform, p in POLICIES if platform == "robotwin"])
def test_robotwin_overall_follows_from_the_source_matrix(policy):
    counts = {
        r["source_policy"]: int(r["n"])
        for r in published.table("source_matrix")
        if r["platform"] == "robotwin"
    }
    matrix = source_rows("robotwin")
    overall = sum(n * matrix[source][policy] for source, n in counts.items()) / sum(counts.values())
    row = next(p for p in rows_of("robotwin") if p.policy == policy)
    assert 100 * overall == pytest.approx(100 * row.rsr.value, abs=0.02)


def test_libero_natural_rates_follow_from_the_source_matrix():
    matrix = source_rows("libero")
    counts = {
        r["source_policy"]: int(r["n"]) for r in published.table("source_matrix") if r["platform"] == "libero"
    }
    for row in published.table("libero_groups"):
        if row["group"] == "natural":
            rate = sum(counts[s] * matrix[s][row["policy"]] for s in counts) / int(row["n"])
            assert 100 * rate == pytest.approx(float(row["rsr"]), abs=0.06)


@pytest.mark.parametrize(
    ("platform", "inversions", "rho", "tau", "spread", "gaps"),
    [("robotwin", 2, 0.83, 0.73, 26.90, (1.90, 31.67)), ("libero", 6, 0.43, 0.20, 26.60, (29.77, 50.83))],
)
def test_order_of_policies(platform, inversions, rho, tau, spread, gaps):
    initial = [p.initial.value for p in rows_of(platform)]
    recovery = [p.rsr.value for p in rows_of(platform)]
    assert len(inverted_pairs(initial, recovery)) == inversions
    assert stats.spearmanr(initial, recovery).statistic == pytest.approx(rho, abs=0.005)
    assert stats.kendalltau(initial, recovery).statistic == pytest.approx(tau, abs=0.005)
    assert 100 * (max(recovery) - min(recovery)) == pytest.approx(spread, abs=0.006)
    lost = 100 * (np.array(initial) - recovery)
    assert (lost.min(), lost.max()) == (pytest.approx(gaps[0], abs=0.006), pytest.approx(gaps[1], abs=0.006))


def test_contrasts_are_differences_of_the_overall_rates():
    rows = {(p.platform, p.policy): p for p in rows_of(None)}
    assert len(published.table("contrasts")) == 30
    for row in published.table("contrasts"):
        a, b = (rows[row["platform"], row[f"policy_{k}"]] for k in "ab")
        assert 100 * (a.rsr.value - b.rsr.value) == pytest.approx(float(row["rsr_diff"]), abs=0.011)
        assert 100 * (a.initial.value - b.initial.value) == pytest.approx(
            float(row["initial_diff"]), abs=0.011
        )
        assert float(row["rsr_lo"]) < float(row["rsr_diff"]) < float(row["rsr_hi"])


@pytest.mark.parametrize(("platform", "gain"), [("robotwin", 36.13), ("libero", 27.40)])
def test_oracle_gain(platform, gain):
    best = max(p.rsr.value for p in rows_of(platform))
    assert 100 * (ORACLE[platform][0] - best) == pytest.approx(gain, abs=0.006)


def test_gains_of_the_observed_best_alternative():
    gains = {}
    for platform in published.PLATFORMS:
        for source, rates in source_rows(platform).items():
            best = max(rate for policy, rate in rates.items() if policy != source)
            gains[platform, source] = 100 * (best - rates[source])
    robotwin = [g for (platform, _), g in gains.items() if platform == "robotwin"]
    assert (min(robotwin), max(robotwin)) == (
        pytest.approx(40.28, abs=0.011),
        pytest.approx(52.02, abs=0.011),
    )
    assert gains["libero", "pi0"] == pytest.approx(38.75, abs=0.011)
    assert gains["libero", "pi05"] == pytest.approx(61.67, abs=0.011)


@pytest.mark.parametrize("row", published.table("monitor_validation"), ids=lambda r: r["validation"])
def test_monitor_metrics_follow_from_the_confusion_matrix(row):
    counts = np.array([[float(row[k]) for k in ("tn", "fp", "fn", "tp")]])
    metrics = dict(zip(METRICS, metric_columns(counts)[0], strict=True))
    for name, value in metrics.items():
        column = "fpr" if name == "false_positive_rate" else name
        assert 100 * value == pytest.approx(float(row[column]), abs=0.0051), column


def test_counts_add_up():
    for platform in published.PLATFORMS:
        assert sum(cell_counts(platform).values()) == 200
    for row in published.table("corpus"):
        assert int(row["scenarios"]) == sum(int(row[k]) for k in ("natural", "perturbed", "human"))
    for row in published.table("monitor_data"):
        assert int(row["frames"]) == int(row["label0"]) + int(row["label1"])
    for split, total in (("train", 800), ("test", 200)):
        robotwin = [r for r in published.table("source_policy_counts") if r["platform"] == "robotwin"]
        assert sum(int(r[split]) for r in robotwin) == total


def test_direct_control_in_the_intervention_table_is_the_overall_rate():
    direct = next(r for r in published.table("interventions") if r["setting"] == "direct")
    pi05 = next(p for p in rows_of("libero") if p.policy == "pi05")
    assert float(direct["rsr"]) == pytest.approx(100 * pi05.rsr.value)
