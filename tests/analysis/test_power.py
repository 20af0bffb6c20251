"""Plans: the formula against the exact test, what a pilot says, and the command."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.panel import make_panel
from lerobot_roborecover.analysis.stats.power import (
    PowerAssumptions,
    detectable,
    guess_from,
    plans,
    power,
    scenarios_for,
    simulated_power,
    true_rates,
    variance_of_difference,
)
from lerobot_roborecover.cli.main import main
from tests.support.trial_rows import policy_rows, trial_row, write_log


@pytest.mark.parametrize(
    "guess",
    [PowerAssumptions(0.5, 0.0, 0.0), PowerAssumptions(0.3, 0.3, 0.7), PowerAssumptions(0.5, 0.5, 0.5)],
)
@pytest.mark.parametrize(("trials", "difference", "family"), [(1, 0.2, 1), (5, 0.2, 15), (3, 0.12, 1)])
def test_the_formula_agrees_with_the_exact_test(guess, trials, difference, family):
    n = scenarios_for(guess, difference, trials, family=family)
    found = simulated_power(guess, difference, n, trials, family=family, samples=400)
    assert 0.72 < found < 0.95
    assert power(guess, difference, n - 1, trials, family=family) < 0.8


def test_between_policies_that_are_alike_the_made_up_test_keeps_its_size():
    assert simulated_power(PowerAssumptions(0.5, 0.3, 0.5), 0.0, 40, 3, samples=400) < 0.09


def test_more_of_anything_that_helps_helps():
    guess = PowerAssumptions(0.4, 0.25, 0.5)
    assert scenarios_for(guess, 0.2, 5) < scenarios_for(guess, 0.2, 1) < scenarios_for(guess, 0.1, 1)
    assert scenarios_for(guess, 0.2, 1) < scenarios_for(guess, 0.2, 1, family=15)
    assert scenarios_for(guess, 0.2, 1) < scenarios_for(guess, 0.2, 1, 0.95)
    assert scenarios_for(PowerAssumptions(0.4, 0.25, 1.0), 0.2, 5) < scenarios_for(guess, 0.2, 5)
    assert detectable(guess, 200, 1) < detectable(guess, 60, 1)
    assert power(guess, detectable(guess, 60, 2), 60, 2) == pytest.approx(0.8, abs=1e-6)
    assert np.isnan(detectable(guess, 6, 1)), "six scenarios show nothing"
    assert scenarios_for(guess, 1e-5, 1) is None


def test_made_up_rates_have_the_moments_that_were_asked_for():
    guess = PowerAssumptions(0.3, 0.25, 0.6)
    a, b = true_rates(np.random.default_rng(0), guess, 0.2, (1, 100_000))
    assert a.mean() == pytest.approx(0.3, abs=0.01)
    assert b.mean() == pytest.approx(0.5, abs=0.01)
    assert a.std() == pytest.approx(0.25, abs=0.01)
    assert np.corrcoef(a[0], b[0])[0, 1] == pytest.approx(0.6, abs=0.03)
    seen = np.random.default_rng(1).binomial(3, b) / 3 - np.random.default_rng(2).binomial(3, a) / 3
    assert seen.var() == pytest.approx(variance_of_difference(guess, 0.2, 3), rel=0.03)


def pilot(tmp_path, *policies, count=400, trials=4):
    logs = [
        str(write_log(tmp_path / f"{p}.jsonl", policy_rows(p, count, trials, rate, seed)))
        for p, rate, seed in policies
    ]
    return logs, make_panel(read_study(logs).arms)


@pytest.mark.slow
def test_a_pilot_gives_rate_scatter_and_correlation_and_never_the_difference(tmp_path):
    # The same seed: the same scenarios are hard for both, clipped to [.02, .98].
    _, panel = pilot(tmp_path, ("a", 0.5, 1))
    one = guess_from(panel)
    truth = np.clip(0.5 + np.random.default_rng(0).normal(0, 0.3, 100_000), 0.02, 0.98)
    assert one.rate == pytest.approx(0.5, abs=0.05)
    assert one.sd == pytest.approx(truth.std(), abs=0.04)
    assert one.correlation == 0.5
    assert guess_from(panel, rate=0.2).sd < one.sd
    _, both = pilot(tmp_path, ("a", 0.5, 1), ("b", 0.7, 2))
    two = guess_from(both)
    assert two.rate == pytest.approx(0.5, abs=0.05), "the worse one's"
    assert two.correlation < 0.2
    rows = policy_rows("c", 400, 4, 0.5, 1)
    again = [str(write_log(tmp_path / "c.jsonl", rows)), str(tmp_path / "a.jsonl")]
    assert guess_from(make_panel(read_study(again).arms)).correlation > 0.9
    assert guess_from(both, correlation=0.3).correlation == 0.3


def test_what_cannot_be_planned_is_refused(tmp_path):
    with pytest.raises(RowsError, match=r"--sd=60: .* cannot scatter by more than 50\.0 points"):
        PowerAssumptions(0.5, 0.6, 0.5)
    with pytest.raises(RowsError, match="must be above 0 and below 10 points"):
        plans(PowerAssumptions(0.9, 0.1, 0.5), [0.2], [1])
    _, single = pilot(tmp_path, ("a", 0.5, 1), trials=1)
    with pytest.raises(RowsError, match="one trial a scenario"):
        guess_from(single)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "neither --pilot nor --rate"),
        (["--rate", "0"], "--rate=0 is not between"),
        (["--rate", "50", "--power", "100"], "--power=100"),
        (["--rate", "50", "--scenarios", "3"], "--scenarios=3 is not from 6"),
        (["--rate", "50", "--trials", "0"], "--trials 0"),
        (["--rate", "50", "--family", "0"], "--family=0"),
        (["--rate", "50", "--correlation", "2"], "--correlation=2"),
        (["--rate", "50", "--scenarios", "no_such_set"], "no_such_set"),
    ],
)
def test_bad_arguments_get_one_line(arguments, words, capsys):
    assert main(["plan", *arguments]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


def test_command(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["plan", "--rate", "50", "--difference", "30", "--trials", "1", "2", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "Scenarios that separate two policies with 80 % chance" in text
    assert {f.name for f in out.iterdir()} == {"plan.csv", "plan.md", "plan.svg", "plan.png"}
    logs, _ = pilot(tmp_path, ("a", 0.5, 1), count=40)
    assert main(["plan", "--pilot", logs[0], "--scenarios", "metaworld_study", "--split", "test"]) == 0
    assert "Least difference that 64 scenarios separate" in capsys.readouterr().out
    three = [str(write_log(tmp_path / f"{p}.jsonl", [trial_row(0, policy=p)])) for p in "xyz"]
    assert main(["plan", *(x for log in three for x in ("--pilot", log))]) == 2
    assert "a plan takes one or two" in capsys.readouterr().err
