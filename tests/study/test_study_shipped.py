"""The studies that ship and that stand in the checkout: trials come out as stored, to the step. Nightly: one
that a bit decides, and a slice of each."""

from __future__ import annotations

import pytest

from recipes.study.__main__ import main
from recipes.study.arms import arms
from recipes.study.definition import read_definition, shipped_study
from recipes.study.evaluate import run_arm, scenario_ids
from recipes.study.outcomes import outcomes_of, read_outcomes

STUDIES = ("metaworld", "metaworld_recovery", "libero", "libero_unscreened", "libero_0")
SLICES = (
    pytest.param("metaworld", 32, marks=pytest.mark.metaworld),
    pytest.param("metaworld_recovery", 180, marks=pytest.mark.metaworld),
    pytest.param("libero", 118, marks=pytest.mark.libero),
    pytest.param("libero_unscreened", 101, marks=pytest.mark.libero),
    pytest.param("libero_0", 100, marks=pytest.mark.libero),
)
"""Two of each study's test scenarios: policies from both starts, and all interventions."""


@pytest.mark.slow
@pytest.mark.parametrize("name", STUDIES)
def test_every_trial_of_the_shipped_study_is_stored(name):
    study = read_definition(shipped_study(name))
    stored = read_outcomes(study.outcomes)
    ids = scenario_ids(study, 1)
    arms = {(f"{name}/{start}", n) for name, n in study.policies.items() for start in ("recovery", "initial")}
    arms |= {(f"{mode}/recovery", study.policies[study.base]) for mode in study.interventions}
    assert set(stored) == {(arm, i, t) for arm, trials in arms for i in ids for t in range(trials)}
    assert all(outcome in ("success", "horizon") for outcome, _ in stored.values())


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.metaworld
@pytest.mark.slow
def test_a_trial_that_a_bit_decides_comes_out_as_stored(tmp_path):
    """One step sooner on an AMD EPYC than on an Intel processor, as long as MKL took the square roots of its
    noise schedule in float32 (`policies/determinism.py`), and with other kernels of MKL."""
    scenario = "scripted-operator-push-v3-s502-000049"
    study = read_definition(shipped_study())
    (arm,) = (a for a in arms(study, tmp_path, [scenario], slots=1) if a.label == "diffusion/initial")
    run_arm(arm, study, [scenario])
    assert outcomes_of([arm]) == {
        (arm.label, scenario, 0): ("success", 126),
        (arm.label, scenario, 1): ("success", 81),
    }


@pytest.mark.lerobot
@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize(("name", "every"), SLICES)
def test_a_slice_comes_out_as_stored(name, every, tmp_path, capsys):
    study = read_definition(shipped_study(name))
    status = main(["--name", name, "--every", str(every), "--out", str(tmp_path), "--no-report"])
    said = capsys.readouterr().out
    trials = 2 * sum(study.policies.values()) + len(study.interventions) * study.policies[study.base]
    total = trials * len(scenario_ids(study, every))
    assert status == 0, said
    assert f"{total} of {total} trials came out as stored, to the step" in said
