"""Measures of detectors: thresholds with a promise, alarms, labels, calibration."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special

from lerobot_roborecover.analysis.stats.calibration import as_probability, calibration, platt
from lerobot_roborecover.analysis.stats.conformal import conformal_threshold, halves, least_rollouts
from lerobot_roborecover.analysis.stats.detection import (
    DEVIATED,
    WILL_FAIL,
    ScoredTrial,
    alarms,
    detection_report,
    frames_of,
)
from lerobot_roborecover.analysis.stats.detection_pairs import detector_contrasts


def trial(number: int, scores, *, start="recovery", success=False, handoff=0, decisions=None) -> ScoredTrial:
    scores = np.asarray(scores, float)
    told = np.zeros(len(scores), bool) if decisions is None else np.asarray(decisions, bool)
    return ScoredTrial(f"s{number}", f"u{number}", start, 0, success, 20.0, handoff, scores, told)


def test_the_threshold_is_the_right_one_of_the_sorted_scores():
    scores = np.arange(1.0, 20.0)  # 19 rollouts: ceil(20 * 0.9) = 18th smallest
    assert conformal_threshold(scores, 0.1) == 18.0
    assert conformal_threshold(scores[::-1], 0.5) == 10.0
    assert conformal_threshold(np.arange(9.0), 0.1) == 8.0  # 9 rollouts are just enough
    assert conformal_threshold(np.arange(8.0), 0.1) == math.inf
    assert least_rollouts(0.1) == 9
    assert least_rollouts(0.05) == 19
    assert conformal_threshold(np.array([np.nan, 1.0, 2.0]), 0.25) == 2.0
    with pytest.raises(ValueError, match="not above 0"):
        conformal_threshold(scores, 1.0)


@given(count=st.integers(1, 60), alpha=st.sampled_from([0.05, 0.1, 0.2, 0.5]))
@settings(max_examples=60, deadline=None)
def test_the_threshold_keeps_its_promise_over_all_orders(count, alpha):
    """Of count + 1 exchangeable rollouts, each once the new one: at most alpha of them is above the threshold
    that the others give."""
    scores = np.random.default_rng(count).permutation(count + 1).astype(float)
    above = [scores[i] > conformal_threshold(np.delete(scores, i), alpha) for i in range(count + 1)]
    assert np.mean(above) <= alpha + 1e-12
    if count >= least_rollouts(alpha):
        assert np.mean(above) > alpha - 1 / (count + 1)


def test_halves_keep_units_together_and_are_halves():
    units = np.array([f"u{i // 3}" for i in range(60)])
    half = halves(units, 0)
    assert all(len(set(half[units == u])) == 1 for u in set(units))
    assert half.sum() == 30
    assert not np.array_equal(half, halves(units, 1))


def noisy(rng, gap: float, units: int = 40) -> tuple[list[ScoredTrial], list[ScoredTrial]]:
    """Two detectors' scores of the same trials; the second is `gap` better at failures."""
    pair: tuple[list[ScoredTrial], list[ScoredTrial]] = [], []
    for unit in range(units):
        fails, shared = bool(rng.random() < 0.4), rng.normal(0, 0.7)
        for start in ("recovery", "initial"):
            helpless = fails and start == "recovery"
            for trials, extra in zip(pair, (0.0, gap), strict=True):
                scores = shared + rng.normal(0, 0.7) + rng.normal(0, 1, 12) + (1.0 + extra) * helpless
                trials.append(trial(unit, scores, start=start, success=not helpless))
    return pair


def reports_of(**scored) -> dict:
    return {
        name: detection_report(trials, alpha=0.1, probabilities=False, decides=False)
        for name, trials in scored.items()
    }


def test_pairs_of_detectors():
    rng = np.random.default_rng(0)
    worse, better = noisy(rng, 3.0)
    reports = reports_of(worse=worse, better=better, same=worse)
    found = {(c.a, c.b): c for c in detector_contrasts(reports)}
    assert set(found) == {("worse", "better"), ("worse", "same"), ("better", "same")}
    assert all(c.family == 3 and c.units == 40 for c in found.values())
    alike, apart = found["worse", "same"], found["worse", "better"]
    assert (alike.difference.value, alike.differing) == (0.0, 0)
    assert not alike.verdict.separated
    roc = {n: r.rankings[WILL_FAIL].roc.area.value for n, r in reports.items()}
    assert apart.difference.value == pytest.approx(roc["worse"] - roc["better"])
    assert apart.verdict.value == "B is better"
    assert apart.difference.high < 0
    assert apart.p_holm >= apart.p
    # Turned round, the same; with one detector in every pair, a smaller family.
    turned = detector_contrasts(reports, against=["worse"])
    assert [(c.a, c.b) for c in turned] == [("better", "worse"), ("same", "worse")]
    assert turned[0].p == pytest.approx(apart.p)
    assert (turned[0].difference.low, turned[0].family) == (pytest.approx(-apart.difference.high), 2)
    # Nothing is said of a detector that says nothing.
    silent = [trial(i, np.full(12, np.nan), success=bool(i % 2)) for i in range(80)]
    assert detector_contrasts(reports_of(silent=silent, worse=worse)) == []


@pytest.mark.nightly
def test_detectors_alike_are_seldom_told_apart():
    rng, wrong = np.random.default_rng(1), 0
    for _ in range(200):
        (c,) = detector_contrasts(reports_of(**dict(zip("ab", noisy(rng, 0.0), strict=True))))
        assert (c.p < 0.05) == (c.difference.low > 0 or c.difference.high < 0)
        wrong += c.p < 0.05
    assert wrong <= 20, f"{wrong} of 200"  # of 5 %, more than 20 have a chance of 0.1 %


def test_labels_say_which_trials_fail():
    trials = [
        trial(0, [0.1, 0.2, 0.3], handoff=1),  # fails from its recovery point
        trial(1, [0.1, 0.2, 0.3], handoff=2, success=True),
        trial(2, [0.1, 0.2], start="initial", success=True),
        trial(3, [0.1, 0.2], start="initial"),  # a clean rollout that fails: the step is unknown
    ]
    deviated, help_ = frames_of(trials, DEVIATED), frames_of(trials, WILL_FAIL)
    assert list(zip(deviated.episode, deviated.step, deviated.label, strict=True)) == [
        (0, 0, 0), (0, 1, 1), (0, 2, 1), (1, 0, 0), (1, 1, 0), (1, 2, 1),
    ]  # fmt: skip
    assert list(zip(help_.episode, help_.step, help_.label, strict=True)) == [
        (0, 1, 1), (0, 2, 1), (1, 2, 0), (2, 0, 0), (2, 1, 0),
    ]  # fmt: skip
    assert frames_of(trials[2:], DEVIATED) is None


def test_alarms_delays_and_minutes_by_hand():
    trials = [
        trial(0, [9, 0, 0, 1, 1], handoff=1),  # the replayed step's 9 is not asked about
        trial(1, [0, 0, 0, 0], success=True),
        trial(2, [1, 0, 1, 1] * 300, start="initial", success=True),  # one minute, 300 alarms and 1 more at 0
        trial(3, [0] * 1200, start="initial", success=True),
        trial(4, [1], start="initial"),
    ]
    found = alarms(trials, [t.after > 0.5 for t in trials])
    assert found.clean == 2
    assert found.clean_alarmed.value == pytest.approx(0.5)
    # 1,1 of one group joins the next group's first 1: [1,0,1,1,1,0,1,1,...] begins 301 alarms in two minutes.
    assert found.alarms_per_minute.value == pytest.approx(301 / 2)
    assert found.detected.value == pytest.approx(0.5)
    assert found.helped.value == 1.0
    assert found.needless.value == 0.0
    assert found.median_delay == (2.0, pytest.approx(0.1))
    none = alarms(trials, [np.zeros(len(t.after), bool) for t in trials])
    assert all(map(math.isnan, none.median_delay))


def test_calibration_by_hand_and_intervals_over_units():
    p = np.array([0.05, 0.05, 0.95, 0.95])
    y = np.array([0, 1, 1, 1])
    found = calibration(p, y, np.array(["a", "a", "b", "b"]))
    assert found.brier.value == pytest.approx((0.05**2 + 0.95**2 + 2 * 0.05**2) / 4)
    assert found.ece.value == pytest.approx((2 * abs(0.05 - 0.5) + 2 * abs(0.95 - 1.0)) / 4)
    assert found.brier.low <= found.brier.value <= found.brier.high
    assert found.frames[0] == 2
    assert found.share[0] == 0.5
    # Frames of one unit are one piece of evidence: the same frames in one unit say nothing about the scatter.
    assert math.isnan(calibration(p, y, np.array(["a"] * 4)).brier.low)
    # A perfect forecaster of fair coins has no calibration error worth the name.
    rng = np.random.default_rng(0)
    chance = rng.uniform(0, 1, 20_000)
    assert calibration(chance, rng.uniform(0, 1, 20_000) < chance, np.arange(20_000) % 50).ece.value < 0.02


def test_platts_curve_finds_the_curve_that_made_the_labels():
    rng = np.random.default_rng(1)
    score = rng.normal(300.0, 50.0, 20_000)
    label = rng.uniform(size=20_000) < special.expit(0.04 * score - 13.0)
    slope, offset = platt(score, label)
    assert slope == pytest.approx(0.04, rel=0.1)
    assert offset == pytest.approx(-13.0, rel=0.1)
    assert platt(score, np.ones(20_000)) is None
    assert np.isnan(as_probability(score[:3], None)).all()
    slope, _ = platt(np.array([0.0, 1.0]), np.array([0, 1]))  # separable: finite all the same
    assert 0 < slope < 10


def test_a_detector_that_knows_is_told_from_one_that_does_not():
    rng = np.random.default_rng(2)
    trials, blind = [], []
    for i in range(40):
        fails = i % 2 == 0
        for start, success in (("recovery", not fails), ("initial", True)):
            needs = start == "recovery" and fails
            trials.append(trial(i, rng.normal(2.0 * needs, 0.5, 30), start=start, success=success))
            blind.append(trial(i, rng.normal(0.0, 0.5, 30), start=start, success=success))
    good = detection_report(trials, alpha=0.2, probabilities=False, decides=False)
    bad = detection_report(blind, alpha=0.2, probabilities=False, decides=False)
    assert good.rankings[WILL_FAIL].roc.area.low > 0.95
    area = bad.rankings[WILL_FAIL].roc.area
    assert area.low < 0.5 < area.high
    assert good.conformal.helped.value > 0.9
    assert good.conformal.clean_alarmed.value <= 0.3
    assert good.calibrated.brier.value < bad.calibrated.brier.value
    assert DEVIATED not in good.rankings  # nothing was replayed here
    assert good.own is None
