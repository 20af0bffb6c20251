"""The numbers of README.md and of the studies' pages are those of the stored outcomes."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.gain_tables import task_gains
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.policy_tables import initial_estimates
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.stats.gains import gains_by_group, groups_by_controller
from lerobot_roborecover.analysis.stats.macro import macro_9_estimates, macro_estimates
from lerobot_roborecover.analysis.stats.ranking import pairs_from_both_starts, rank_agreement
from lerobot_roborecover.analysis.stats.units import ResamplingUnit
from lerobot_roborecover.analysis.tables import Column, cell_text
from recipes.study.definition import read_definition, shipped_study
from recipes.study.stored import write_stored_logs

ROOT = Path(__file__).resolve().parents[2]
MODES = {
    "reversion": "Reversion",
    "correction": "Correction",
    "monitor_reversion": "Monitor + Reversion",
    "monitor_correction": "Monitor + Correction",
}
"""Interventions by their names on the pages."""
PAGES = {
    "metaworld": ("docs/log/metaworld_64.md",),
    "metaworld_recovery": ("README.md", "docs/studies/metaworld_recovery.md"),
    "libero": ("docs/studies/libero.md",),
    "libero_0": ("docs/log/libero_study_0.md",),
}
_RESULTS: dict[str, Results] = {}


@pytest.fixture
def results(request, tmp_path):
    """Results of a study's stored outcomes; worked out once."""
    name = request.param
    if name not in _RESULTS:
        study = read_definition(shipped_study(name))
        logs = [f"{arm.name}={arm.log}" for arm in write_stored_logs(study, tmp_path)]
        options = Options(draws=100, baseline=study.base, interventions=study.interventions)
        _RESULTS[name] = analyse(read_study(logs), options)
    return name, _RESULTS[name]


def cells(page: str) -> list[list[str]]:
    """The rows of all tables of a page, without marks."""
    text = (ROOT / page).read_text(encoding="utf-8")
    rows = [line.strip().strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    return [[cell.replace("`", "").replace(" %", "").strip() for cell in row] for row in rows]


def shown(estimate, kind: str = "percent") -> str:
    return cell_text(estimate, Column("", kind))


def macros_of(found: Results) -> list[list[str]]:
    """Both Macro numbers of every policy as the pages have them: without an interval where there is none."""
    both = macro_estimates, macro_9_estimates
    columns = [[shown(e).replace(" [n/a]", "") for e in of(found.recovery, found.draws)] for of in both]
    return [list(texts) for texts in zip(*columns, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("results", PAGES, indirect=True)
def test_every_policy_s_row_is_that_of_the_stored_outcomes(results):
    name, found = results
    initial = initial_estimates(found)
    rsr, macros = found.draws.rates(found.recovery.rates.T), macros_of(found)
    for page in PAGES[name]:
        rows = cells(page)
        for p, policy in enumerate(found.recovery.arms):
            wanted = [shown(initial[p]), shown(rsr[p])]
            own = [row for row in rows if row[0].split(":")[0] == policy and wanted[0] in row]
            assert own, f"{page}: {policy} {wanted[0]}"
            assert all(wanted[1] in row for row in own)
            if page != "README.md":
                assert all(shown(found.retention[p], "ratio") in row for row in own)
            if name != "metaworld_recovery":  # whose tables have no Macro
                assert all(text in row for text in macros[p] for row in own)


@pytest.mark.slow
@pytest.mark.parametrize("results", ["metaworld_recovery", "libero", "libero_0"], indirect=True)
def test_every_intervention_s_row_has_its_gain_here_and_over_tasks(results):
    name, found = results
    rows = cells(PAGES[name][-1])
    for here, over in zip(found.procedure_contrasts, task_gains(found), strict=True):
        gain, tasks = f"+{shown(here.difference, 'points')}", shown(over.difference, "points")
        (row,) = (row for row in rows if row[0] == MODES[here.a] and gain in row)
        assert tasks[tasks.index("[") :] in row
        assert f"{over.p_holm:.2g}" in row or f"{over.p_holm:.3f}" in row or f"{over.p_holm:.4f}" in row


@pytest.mark.slow
@pytest.mark.parametrize("results", ["metaworld_recovery"], indirect=True)
def test_one_inversion_is_shown_on_meta_world_and_none_over_tasks(results):
    _, found = results
    inverted = [p for p in pairs_from_both_starts(*found.both_starts) if p.inverted]
    assert [{p.initial.a, p.initial.b} for p in inverted if p.shown < 0] == [{"diffusion_few", "act_clean"}]
    agreement = rank_agreement(*found.both_starts)
    assert (agreement.inversions.value, agreement.inversions.low, agreement.inversions.high) == (5, 1, 9)
    tasks = pairs_from_both_starts(*found.both_starts_over(ResamplingUnit.TASK))
    assert not [p for p in tasks if p.shown < 0]
    rows = cells("docs/studies/metaworld_recovery.md")
    for pair in inverted:
        initial = pair.initial if pair.initial.difference.value > 0 else pair.initial.reversed()
        (row,) = (row for row in rows if row[:2] == [initial.a, initial.b])
        assert row[2] == shown(initial.difference, "points")
        assert row[-1] == ("yes" if pair.shown < 0 else "no")


@pytest.mark.slow
@pytest.mark.parametrize("results", ["libero_0"], indirect=True)
def test_one_disturbed_expert_carries_the_gains_on_the_earlier_libero_set(results):
    _, found = results
    panel = found.interventions
    gains = gains_by_group(
        panel, found.intervention_pairs, groups_by_controller(panel), found.resample(panel)
    )
    expert = [g for g in gains if g.group == "perturbed, scripted-open-loop"]
    assert [round(100 * g.outside.difference.value, 1) for g in expert] == [1.0, 9.5, 1.0, 9.5]
    assert [round(g.outside.p_holm, 2) for g in expert] == [1, 0.19, 1, 0.17]
    assert {(g.inside.scenarios, g.outside.scenarios) for g in expert} == {(95, 105)}
    rows = cells("docs/log/libero_study_0.md")
    for gain in expert:
        inside, outside = (f"+{shown(c.difference, 'points')}" for c in (gain.inside, gain.outside))
        assert [row for row in rows if row[0] == MODES[gain.inside.a] and inside in row and outside in row]
