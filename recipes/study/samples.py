"""What screening does to ranks and gains: a study of a set's tests beside that of its unscreened sample.

    python -m recipes.study.samples --name libero     # seconds: nothing is run

Reads the stored outcomes of the studies `NAME` and `NAME_unscreened` and prints Markdown tables: success of
every policy from both starts; all pairs of the policies that did not screen, which are one family in each
sample; the gain of each intervention on all tests, on the tests that are a policy's own failures, and on the
sample, a family each.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.policy_tables import initial_estimates
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.stats.estimators import DRAWS
from lerobot_roborecover.analysis.stats.intervals import Estimate, independent_difference
from lerobot_roborecover.analysis.tables import Cell, Column, Table, to_markdown
from lerobot_roborecover.cli.arguments import Parser, add_options, read_options
from lerobot_roborecover.cli.output import guarded
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.scenario import Source
from recipes.study.definition import StudyDefinition, read_definition, shipped_study
from recipes.study.stored import write_stored_logs

PROGRAM = "python -m recipes.study.samples"


@dataclass(frozen=True, kw_only=True)
class SamplesOptions:
    """Which study."""

    name: str = "libero"
    """Of policies/study."""
    draws: int = DRAWS
    """Bootstrap draws."""


@dataclass(frozen=True)
class Sample:
    """A study's results on one sample of a set's scenarios."""

    everyone: Results
    """All of its policies, and the interventions."""
    family: Results
    """Without the policies that screened the set: pairs of the others are one family."""
    natural: Results
    """The same on the scenarios that a learned policy failed in by itself."""


def read_sample(study: StudyDefinition, draws: int = DRAWS) -> Sample:
    """Works out a study's stored outcomes.

    Args:
        study: what.
        draws: of the bootstrap.

    Raises:
        ScenarioError: nothing is stored, or no longer fits the study.
    """
    screened = screening_policies(study)
    options = Options(draws=draws, baseline=study.base, interventions=study.interventions)

    def results(arms: Sequence[str], source: Source | None = None) -> Results:
        read = read_study(arms)
        if source is not None:
            kept = [
                replace(arm, rows=tuple(r for r in arm.rows if r.source == source.value)) for arm in read.arms
            ]
            read = replace(read, arms=tuple(kept))
        return analyse(read, options)

    with TemporaryDirectory() as folder:
        arms = write_stored_logs(study, Path(folder))
        every = [f"{arm.name}={arm.log}" for arm in arms]
        others = [f"{arm.name}={arm.log}" for arm in arms if arm.name not in screened]
        return Sample(results(every), results(others), results(others, Source.NATURAL))


def screening_policies(study: StudyDefinition) -> set[str]:
    """Names of the policies that were used for screening the study's set."""
    found: set[str] = set()
    for scenario in load_scenarios(study.scenarios, split=study.split):
        found |= scenario.provenance.get("screening", {}).get("policies", {}).keys()
    return found


def rates(tests: Sample, sample: Sample, screened: set[str]) -> Table:
    """Success of every policy from both starts, best on the tests first."""
    titles = (
        "Policy", "used for screening", "initial, tests %", "RSR, tests %", "initial, unscreened %",
        "RSR, unscreened %", "RSR, tests less unscreened",
    )  # fmt: skip
    here, there = _rates(tests.everyone), _rates(sample.everyone)
    rows: list[tuple[Cell, ...]] = [
        (
            name, "yes" if name in screened else "no", *here[name], *there[name],
            independent_difference(here[name][1], there[name][1]),
        )
        for name in tests.everyone.recovery.arms
    ]  # fmt: skip
    kinds = ("text", "text", *["percent"] * 4, "points")
    return Table("rates", "Policies", _columns(titles, kinds), tuple(rows))


def pairs(tests: Sample, sample: Sample) -> Table:
    """All pairs of the policies that did not screen, in the order of the tests."""
    titles = ("Pair", "tests", "p (Holm)", "unscreened", "p (Holm) unscreened", "tests less unscreened")
    rows: list[tuple[Cell, ...]] = []
    for one in tests.family.contrasts:
        other = sample.family.contrast(one.a, one.b)
        rows.append(
            (
                f"{one.a} less {one.b}", one.difference, one.p_holm, other.difference, other.p_holm,
                independent_difference(one.difference, other.difference),
            )
        )  # fmt: skip
    return Table(
        "pairs", "Pairs at recovery", _columns(titles, ("text", *["points", "p"] * 2, "points")), tuple(rows)
    )


def gains(tests: Sample, sample: Sample) -> Table:
    """What each intervention gains over its base policy."""
    titles = (
        "Intervention", "tests", "p (Holm)", "natural tests", "p (Holm) natural", "unscreened",
        "p (Holm) unscreened", "tests less unscreened",
    )  # fmt: skip
    found = (tests.family, tests.natural, sample.family)
    rows: list[tuple[Cell, ...]] = []
    for here, natural, there in zip(*(of.procedure_contrasts for of in found), strict=True):
        numbers = [n for c in (here, natural, there) for n in (c.difference, c.p_holm)]
        rows.append((here.a, *numbers, independent_difference(here.difference, there.difference)))
    return Table(
        "gains", "Interventions", _columns(titles, ("text", *["points", "p"] * 3, "points")), tuple(rows)
    )


def _rates(found: Results) -> dict[str, tuple[Estimate, Estimate]]:
    both = zip(initial_estimates(found), found.draws.rates(found.recovery.rates.T), strict=True)
    return dict(zip(found.recovery.arms, both, strict=True))


def _columns(titles: Sequence[str], kinds: Sequence) -> tuple[Column, ...]:
    return tuple(Column(title, kind) for title, kind in zip(titles, kinds, strict=True))


def run(options: SamplesOptions) -> int:
    """Prints the tables."""
    studies = [read_definition(shipped_study(name)) for name in (options.name, f"{options.name}_unscreened")]
    tests, sample = (read_sample(study, options.draws) for study in studies)
    for table in (
        rates(tests, sample, screening_policies(studies[0])),
        pairs(tests, sample),
        gains(tests, sample),
    ):
        print(to_markdown(table))
    return 0


def main(argv: Sequence[str]) -> int:
    """Runs the command and turns a refusal into one line; returns the exit status."""
    parser = Parser(prog=PROGRAM, description=__doc__)
    add_options(parser, SamplesOptions)
    return guarded(PROGRAM, lambda: run(read_options(SamplesOptions, parser.parse_args(argv))))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
