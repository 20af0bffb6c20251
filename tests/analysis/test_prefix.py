"""Recovery by length of the prefix: groups, rates, intervals over the report's units, table and figure."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.figures.prefix import prefix_figure
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.report_tables import all_tables
from lerobot_roborecover.analysis.stats.prefix import prefix_groups, prefix_steps
from lerobot_roborecover.analysis.stats.resampling import resample
from tests.support.trial_rows import trial_row, write_log


def results_of(folder, steps, success=lambda n, policy: n % 2 == 0, policies=("a", "b"), **options):
    """Scenario n has a prefix of `steps[n]` actions, and one trial by each policy."""
    rows = [
        trial_row(n, 0, success(n, policy), policy=policy, handoff_step=length)
        for policy in policies
        for n, length in enumerate(steps)
    ]
    return analyse(read_study([str(write_log(folder / "log.jsonl", rows))]), Options(draws=100, **options))


def test_quarters_by_length_with_their_own_rates(tmp_path):
    steps = [100 - n for n in range(40)]  # longest first, so that the order is not the scenarios' own
    results = results_of(tmp_path, steps, lambda n, policy: policy == "a" and n < 20)
    assert prefix_steps(results.recovery).tolist() == steps
    groups = prefix_groups(results.recovery, results.draws)
    assert [(g.label, g.scenarios, g.median_steps) for g in groups] == [
        ("61 to 70", 10, 65.5), ("71 to 80", 10, 75.5), ("81 to 90", 10, 85.5), ("91 to 100", 10, 95.5),
    ]  # fmt: skip
    a = results.recovery.arm("a")
    assert [g.estimates[a].value for g in groups] == [0, 0, 1, 1]
    assert {g.estimates[1 - a].value for g in groups} == {0}
    (table,) = [table for table in all_tables(results) if table.name == "prefix"]
    assert [row[:2] for row in table.rows] == [(g.label, g.scenarios) for g in groups]
    figure = prefix_figure(results)
    assert "61 to 70 steps: a 0, b 0" in figure.description
    assert "91 to 100 steps: a 100, b 0" in figure.description
    assert figure.narrow is not None


@pytest.mark.parametrize("cluster", ["scenario", "task"])
def test_intervals_are_over_the_units_of_the_statistics(tmp_path, cluster):
    results = results_of(tmp_path, list(range(1, 41)), lambda n, policy: n % 3 == 0, cluster=cluster)
    panel, options = results.recovery, results.options
    index = np.arange(10)
    own = resample(panel.units(options.cluster)[index], options.draws, options.seed, options.level)
    found = prefix_groups(panel, results.draws)[0].estimates
    assert found == tuple(own.rates(panel.rates[:, index].T))


@pytest.mark.parametrize(
    ("steps", "labels"),
    [
        ([40] * 40, []),  # one length
        (list(range(1, 20)), []),  # too few for two groups
        ([0] * 40, []),  # not known
        ([5] * 25 + [9] * 15, ["5", "9"]),  # equal lengths stay together
    ],
)
def test_lengths_that_make_no_groups_or_few(tmp_path, steps, labels):
    results = results_of(tmp_path, steps)
    groups = prefix_groups(results.recovery, results.draws)
    assert [g.label for g in groups] == labels
    assert (prefix_figure(results) is None) == (not labels)
    assert ("prefix" in {table.name for table in all_tables(results)}) == bool(labels)
