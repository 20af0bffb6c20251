"""A report on many policies: work that grows with their number, and not with the number of their pairs."""

from __future__ import annotations

import pytest

from lerobot_roborecover.analysis import pair_tables
from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.figures.rates import MOST_COLUMNS, all_figures, paired_differences
from lerobot_roborecover.analysis.figures.style import MOST_LINES, MOST_ROWS
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.results import MOST_PAIRS
from tests.support.trial_rows import policy_rows, write_log


def results_of(folder, policies):
    logs = [
        str(write_log(folder / f"{p}.jsonl", policy_rows(f"p{p:02d}", 8, 2, 0.1 + 0.8 * p / policies, p)))
        for p in range(policies)
    ]
    return analyse(read_study(logs), Options(draws=100))


@pytest.mark.parametrize(("policies", "shown"), [(4, 6), (16, 120), (17, 16), (40, 39)])
def test_pairs_that_are_drawn_and_dealt_are_bounded(tmp_path, monkeypatch, policies, shown):
    """120 policies are 7,140 pairs: a figure of as many rows took 209 s and 3.1 GB."""
    results = results_of(tmp_path, policies)
    calls, own = [], pair_tables.profile_difference
    monkeypatch.setattr(
        pair_tables, "profile_difference", lambda *args: calls.append(args[1:3]) or own(*args)
    )
    profiles, contrasts = pair_tables.profiles(results), pair_tables.paired_contrasts(results)
    pairs = policies * (policies - 1) // 2
    assert len(calls) == len(profiles.rows) == shown <= MOST_PAIRS
    assert len(contrasts.rows) == pairs, "every pair has its numbers"
    figure = paired_differences(results)
    axes = figure.plot.axes[0]
    assert len(axes.get_yticks()) == shown
    best = results.recovery.arms[0]
    if shown < pairs:
        assert {row[0] for row in profiles.rows} == {best}
        assert figure.description.startswith(f"{best} against every other policy: ")
        assert f"The table has all {pairs} pairs." in figure.description
        assert f"Only {best} against every other policy, of {pairs} pairs." in profiles.notes


@pytest.mark.nightly
@pytest.mark.slow
def test_figures_show_the_best_and_say_so(tmp_path):
    """120 rows, columns and lines cannot be read, and took a minute of processor time to lay out."""
    count = 45
    figures = {figure.name: figure for figure in all_figures(results_of(tmp_path, count))}
    axes = {name: figure.plot.axes[0] for name, figure in figures.items()}
    assert len(axes["forest"].get_yticks()) == MOST_ROWS
    assert len(axes["time_to_recover"].get_lines()) == len(axes["retries"].get_lines()) == MOST_LINES
    for name, shown in (
        ("forest", MOST_ROWS),
        ("time_to_recover", MOST_LINES),
        ("cells", MOST_COLUMNS[False]),
    ):
        assert figures[name].description.endswith(f"The best {shown} of {count} policies."), name
    for narrow, plot in ((False, figures["cells"].plot), (True, figures["cells"].narrow)):
        assert len(plot.axes[0].get_xticks()) == MOST_COLUMNS[narrow]
        assert plot.axes[0].get_xlabel() == f"the best {MOST_COLUMNS[narrow]} of {count} policies"
    assert len(axes["outcomes"].get_yticks()) == count, "one start of each"
