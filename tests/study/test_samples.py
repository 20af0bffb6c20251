"""A study of tests beside that of an unscreened sample: families, and what is told of the difference."""

from __future__ import annotations

import pytest

from recipes.study.definition import read_definition, shipped_study
from recipes.study.samples import gains, pairs, rates, read_sample, screening_policies


@pytest.mark.slow
def test_only_policies_that_did_not_screen_are_one_family():
    study = read_definition(shipped_study("libero_0"))
    sample = read_sample(study, 100)
    screened = screening_policies(study)
    assert screened == {"act", "act_clean", "act_recover", "act_recover_large"}
    assert [row[:2] for row in rates(sample, sample, screened).rows][-2:] == [
        ("act_few", "no"),
        ("act_clean", "yes"),
    ]
    (pair,) = pairs(sample, sample).rows
    assert pair[0] == "diffusion less act_few"
    assert (pair[1].value, pair[-1].value) == (pytest.approx(0.225), 0)
    assert sample.family.contrasts[0].family == 1
    assert len(sample.everyone.contrasts) == 15


@pytest.mark.slow
def test_natural_scenarios_are_a_family_of_their_own():
    sample = read_sample(read_definition(shipped_study("libero_0")), 100)
    assert [s.source for s in sample.natural.recovery.scenarios] == ["natural"] * 44
    assert {c.family for c in sample.natural.procedure_contrasts} == {4}
    rows = {row[0]: row for row in gains(sample, sample).rows}
    # Rescued less harmed of the 44: 5 - 5, 6 - 4, 5 - 5 and 5 - 2.
    assert [round(44 * row[3].value) for row in rows.values()] == [0, 2, 0, 3]
    assert [round(200 * row[1].value) for row in rows.values()] == [34, 29, 36, 26]
