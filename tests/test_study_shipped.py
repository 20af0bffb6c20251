"""A slice of the shipped study: every trial comes out as stored, to the step."""

from __future__ import annotations

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.study.definition import read_definition, shipped_study
from lerobot_roborecover.study.evaluate import scenario_ids
from lerobot_roborecover.study.outcomes import read_outcomes

EVERY = 32
"""Two of the test scenarios: policies from both starts, and all interventions."""


@pytest.fixture(scope="module")
def study():
    return read_definition(shipped_study())


def test_every_trial_of_the_shipped_study_is_stored(study):
    stored = read_outcomes(study.outcomes)
    ids = scenario_ids(study, 1)
    arms = {(f"{name}/{start}", n) for name, n in study.policies.items() for start in ("recovery", "initial")}
    arms |= {(f"{mode}/recovery", study.policies[study.base]) for mode in study.interventions}
    assert set(stored) == {(arm, i, t) for arm, trials in arms for i in ids for t in range(trials)}
    assert all(outcome in ("success", "horizon") for outcome, _ in stored.values())


@pytest.mark.lerobot
@pytest.mark.metaworld
@pytest.mark.slow
def test_a_slice_comes_out_as_stored(study, tmp_path, capsys):
    status = main(["study", "--every", str(EVERY), "--out", str(tmp_path), "--no-report"])
    said = capsys.readouterr().out
    trials = 2 * sum(study.policies.values()) + len(study.interventions) * study.policies[study.base]
    total = trials * len(scenario_ids(study, EVERY))
    assert status == 0, said
    assert f"{total} of {total} trials came out as stored, to the step" in said
