"""A measured rate beside a published one: intervals against a worked example, and what may be said."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from lerobot_roborecover.analysis.stats.agreement import AgreementVerdict, agreement, mixed_rate
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.reproduce import find_checkpoint, known_names
from lerobot_roborecover.reproduce.arms import published_score
from lerobot_roborecover.reproduce.hours import Costs, run_length
from tests.support.factories import fake_scenario


def test_the_interval_of_the_difference_is_newcombes():
    """Newcombe (1998), example (a) of table II: 56/70 and 48/80, method 10: 0.0524 to 0.3339."""
    from scipy.stats import binomtest

    def wilson(k, n):
        ci = binomtest(k, n).proportion_ci(0.95, "wilson")
        return Estimate(k / n, ci.low, ci.high)

    found = agreement(wilson(56, 70), wilson(48, 80))
    assert found.difference.value == pytest.approx(0.2)
    assert found.difference.low == pytest.approx(0.0524, abs=1e-4)
    assert found.difference.high == pytest.approx(0.3339, abs=1e-4)
    assert found.standing is AgreementVerdict.HIGHER


@pytest.mark.parametrize(
    ("measured", "standing"),
    [
        ((0.93, 0.90, 0.96), AgreementVerdict.AGREES),
        ((0.93, 0.80, 0.98), AgreementVerdict.UNDECIDED),
        ((0.70, 0.60, 0.78), AgreementVerdict.LOWER),
        ((0.99, 0.985, 1.0), AgreementVerdict.HIGHER),
        ((0.0, math.nan, math.nan), AgreementVerdict.UNPUBLISHED),
        ((math.nan, math.nan, math.nan), AgreementVerdict.UNMEASURED),
    ],
)
def test_what_may_be_said(measured, standing):
    assert agreement(Estimate(*measured), Estimate(0.9417, 0.915, 0.965)).standing is standing
    unpublished = AgreementVerdict.UNPUBLISHED if standing is not AgreementVerdict.UNMEASURED else standing
    assert agreement(Estimate(*measured), None).standing is unpublished


def test_a_published_rate_without_interval_is_taken_as_exact():
    found = agreement(Estimate(0.9, 0.8, 0.95), Estimate(0.97, math.nan, math.nan))
    assert (found.difference.low, found.difference.high) == pytest.approx((-0.17, -0.02))


def test_suites_are_weighed_as_the_set_is_made_up():
    found = mixed_rate([0.5, 1.0], [0.25, 0.75], 100)
    assert found.value == pytest.approx(0.875)
    # Wilson: 50 of 100 is 0.404 to 0.596, 100 of 100 is 0.963 to 1.
    assert (found.low, found.high) == pytest.approx((0.8383, 0.8990), abs=1e-4)
    assert math.isnan(mixed_rate([0.5], [1.0], None).low)


@pytest.mark.parametrize("text", ["", "a", "101", "90,80", "90,95,99", "90,80,85", "-1"])
def test_published_scores_are_checked(text):
    from lerobot_roborecover.errors import OptionError

    with pytest.raises(OptionError, match="--published"):
        published_score(text)


def test_every_checkpoint_of_policies_eval_is_known_and_the_other_way_round():
    found = [find_checkpoint(name) for name in known_names()]
    folder = found[0].config.parent
    assert {c.config.name for c in found} == {path.name for path in folder.glob("*.yaml")}
    by_name = {c.name: c for c in found}
    assert by_name["pi05_libero"].initial.rate == Estimate(0.9417, 0.915, 0.965)
    assert by_name["pi05_libero"].recovery.value == pytest.approx(0.644)
    assert all(c.initial is not None and c.recovery is not None for c in found)
    base = fake_scenario(0)
    libero = [
        replace(base, task=replace(base.task, suite=suite), fingerprint=None)
        for suite in ("libero_spatial", "libero_10")
    ]
    assert by_name["pi05_libero"].of_makers(libero).rate.value == pytest.approx(0.965)
    assert by_name["pi05_libero"].of_makers([fake_scenario(0)]) is None
    assert by_name["pi0_libero"].of_makers(libero) is None


def test_hours_follow_from_the_costs():
    """Two scenarios, horizons of 45, prefixes of 10, 5 actions an inference, 4 trials: worked by hand."""
    costs = Costs(step_ms=10, picture_ms=50, inference_ms=200, slots=2, batch=4)
    scenarios = [fake_scenario(0), fake_scenario(1)]
    found = run_length(scenarios, 4, 5, costs, replay=True)
    assert (found.trials, found.steps, found.looks) == (8, 360, 72)
    assert found.simulator_h * 3600 == pytest.approx((380 * 0.010 + 72 * 0.050) / 2)
    assert found.policy_h * 3600 == pytest.approx(72 / 4 * 0.2)
    assert found.hours == found.simulator_h
