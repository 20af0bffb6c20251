"""A study of tests beside that of an unscreened sample: families, what is told of the difference, and the
study's pages."""

from __future__ import annotations

import functools

import pytest

from lerobot_roborecover.analysis.stats.gains import gains_by_group
from lerobot_roborecover.analysis.tables import Cell, Column, cell_text
from recipes.study.definition import read_definition, shipped_study
from recipes.study.samples import Sample, gains, pairs, rates, read_sample, screening_policies
from tests.study.test_published_numbers import MODES, cells

PAGE = "docs/studies/libero.md"


@functools.cache
def sample_of(name: str) -> Sample:
    return read_sample(read_definition(shipped_study(name)), 100)


def on_page(value: Cell, kind: str) -> str:
    return cell_text(value, Column("", kind))


@pytest.mark.slow
def test_only_policies_that_did_not_screen_are_one_family():
    study = read_definition(shipped_study("libero_0"))
    sample = sample_of("libero_0")
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
    sample = sample_of("libero_0")
    assert [s.source for s in sample.natural.recovery.scenarios] == ["natural"] * 44
    assert {c.family for c in sample.natural.procedure_contrasts} == {4}
    rows = {row[0]: row for row in gains(sample, sample).rows}
    # Rescued less harmed of the 44: 5 - 5, 6 - 4, 5 - 5 and 5 - 2.
    assert [round(44 * row[3].value) for row in rows.values()] == [0, 2, 0, 3]
    assert [round(200 * row[1].value) for row in rows.values()] == [34, 29, 36, 26]


@pytest.mark.slow
def test_the_page_of_the_study_says_what_is_stored():
    tests, sample = sample_of("libero"), sample_of("libero_unscreened")
    screened = screening_policies(read_definition(shipped_study("libero")))
    page = cells(PAGE)
    for name, _, _, _, initial, recovery, less in rates(tests, sample, screened).rows:
        wanted = [on_page(initial, "percent"), on_page(recovery, "percent"), on_page(less, "points")]
        assert [name, *wanted] in page
    separated = []
    for name, here, p_here, there, p_there, less in pairs(tests, sample).rows:
        (row,) = (row for row in page if row[0] == name)
        assert [row[1], row[3]] == [on_page(here, "points"), on_page(there, "points")]
        separated.append((p_here < 0.05, p_there < 0.05))
        assert less.low < 0 < less.high
    assert len(separated) == 10
    assert [sum(found) for found in zip(*separated, strict=True)] == [7, 9]
    for mode, here, p_here, natural, p_natural, there, p_there, _ in gains(tests, sample).rows:
        wanted = {f"+{on_page(gain, 'points')}" for gain in (natural, there)}
        assert any(row[0] == MODES[mode] and wanted <= set(row) for row in page), mode
        assert any(row[0] == MODES[mode] and f"+{on_page(here, 'points')}" in row for row in page), mode
        assert [p < 0.05 for p in (p_here, p_natural, p_there)] == [mode == "reversion", False, False]


@pytest.mark.slow
def test_the_log_of_the_study_says_what_is_stored():
    """Rates by source and suite, and gains by source: each in the row of its group."""
    found = sample_of("libero").everyone
    page = cells("docs/log/libero_study.md")
    (arms,) = (row[2:] for row in page if row[0] == "source")
    panel = found.recovery
    rates = {name: 100 * panel.rates[n] for n, name in enumerate(panel.arms)}
    for labels in (panel.labels("source"), panel.labels("suite")):
        for group in set(labels):
            (row,) = (row for row in page if row[0] == group)
            of = [label == group for label in labels]
            assert int(row[1]) == sum(of)
            wanted = pytest.approx([rates[name][of].mean() for name in arms], abs=0.0501)  # of one digit
            assert [float(cell.split()[0]) for cell in row[2:]] == wanted
    panel = found.interventions
    (titles,) = (row for row in page if row[0] == "gain, points (p, Holm)")
    for gain in gains_by_group(
        panel, found.intervention_pairs, panel.labels("source"), found.resample(panel)
    ):
        (place,) = (n for n, title in enumerate(titles) if title == f"{gain.group} ({gain.inside.scenarios})")
        (row,) = (row for row in page if row[0] == MODES[gain.inside.a] and len(row) == len(titles))
        assert row[place].startswith(f"{on_page(gain.inside.difference, 'points')} (")
