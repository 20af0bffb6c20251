"""A slice of the shipped study: every trial comes out as stored, to the step."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.study.definition import read_definition, shipped_study
from lerobot_roborecover.study.evaluate import scenario_ids
from lerobot_roborecover.study.outcomes import read_outcomes

EVERY = 32
"""Two of the test scenarios: policies from both starts, and all interventions."""


RECORDED_ON = {"vendor_id": "GenuineIntel", "model": "167"}
"""Processor that the outcomes are from. Torch's kernels are chosen alike everywhere (`study.json`,
environment), but nobody has tried another processor yet."""
ALIKE = 0.8
"""Share of trials whose outcome has to be the same there, should a last bit differ after all."""


def processor() -> dict[str, str]:
    """Vendor and model, as far as Linux tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return {}
    found = dict(reversed([[part.strip() for part in line.split(":", 1)] for line in lines if ":" in line]))
    return {key: found.get(key, "") for key in RECORDED_ON}


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
    stored, today = read_outcomes(study.outcomes), read_outcomes(tmp_path / "outcomes.csv")
    assert len(today) == total
    if processor() != RECORDED_ON and status == 1:
        same = sum(stored[key][0] == outcome for key, (outcome, _) in today.items())
        assert same >= ALIKE * total, said
        return
    assert status == 0, said
    assert f"{total} of {total} trials came out as stored, to the step" in said
