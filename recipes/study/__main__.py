"""Runs a study again: `python -m recipes.study --name NAME`, in the top folder of a clone."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.cli.arguments import Parser, add_options, read_options
from lerobot_roborecover.cli.output import guarded
from lerobot_roborecover.utils.options import option

PROGRAM = "python -m recipes.study"

HELP = (
    "Re-run a study: every policy from recovery points and from initial states, the interventions, the "
    "report, and the comparison with the stored outcomes, trial by trial."
)


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """Which study to run, and how much of it."""

    name: str = "metaworld"
    """Which study of policies/study."""
    data: Path | None = None
    """Folder of another study."""
    out: Path = Path("outputs/study")
    """Folder of the results."""
    stride: int = option(1, metavar="N", old=("every",))
    """Take every N-th scenario only."""
    jobs: int = 0
    """Runs of policies at once (0: one per core)."""
    slots: int = 0
    """Simulators at once in each (0: the cores left for it)."""
    make: bool = False
    """Make the study first, from nothing but the packages: train, build, fine-tune (hours)."""
    shipped_scenarios: bool = False
    """With --make: take the scenarios that come with the package instead of building them."""
    stages: tuple[str, ...] = option((), name="stage", metavar="NAME")
    """With --make: this stage only; again."""
    print: bool = False
    """Print the commands and run nothing."""
    use_stored_outcomes: bool = option(False, old=("stored",))
    """Run nothing: print the tables, and write the report below --out/stored, of the stored outcomes."""
    no_report: bool = False
    """Stop after the trials and the comparison."""


def main(argv: Sequence[str]) -> int:
    """Runs the command and turns a refusal into one line; returns the exit status."""
    os.environ.setdefault("SVT_LOG", "1")  # the video encoder: errors only, not a page a video
    return guarded(PROGRAM, lambda: run(read_options(StudyOptions, build_parser().parse_args(argv))))


def build_parser() -> Parser:
    """Returns the parser of the command's options."""
    parser = Parser(prog=PROGRAM, description=HELP)
    add_options(parser, StudyOptions)
    return parser


def run(options: StudyOptions) -> int:
    """Evaluates, compares, reports; exit status 1 where outcomes differ from the stored ones."""
    from lerobot_roborecover.errors import OptionError
    from recipes.study.arms import arms, report_command
    from recipes.study.definition import read_definition, shipped_study
    from recipes.study.evaluate import (
        compare_with_stored,
        evaluate,
        scenario_ids,
        write_report,
    )
    from recipes.study.outcomes import outcomes_of, write_outcomes

    if options.stride < 1:
        raise OptionError(f"--stride={options.stride}: a count from 1")
    for name in ("jobs", "slots"):
        if getattr(options, name) < 0:
            raise OptionError(f"--{name}={getattr(options, name)}: a count; 0 follows the cores")
    if options.stages and not options.make:
        raise OptionError("--stage names a stage of --make; add --make")
    if options.shipped_scenarios and not options.make:
        raise OptionError("--shipped-scenarios is of --make; add --make")
    if options.make:
        if options.data:
            raise OptionError("--make makes its own data below --out; leave out --data")
        from recipes.study.make import make

        made = make(
            options.name, options.out, options.stages, lambda line: print(line, flush=True),
            shipped=options.shipped_scenarios,
        )  # fmt: skip
        if made is None:
            return 0
    given = options.out / "data" if options.make else options.data
    study = read_definition(given or shipped_study(options.name))
    if options.print:
        ids = scenario_ids(study, options.stride) if options.stride > 1 else ()
        todo = list(arms(study, options.out, ids, options.slots))
        for line in [*(a.run.command_line() for a in todo), report_command(study, todo, options.out)]:
            print(line)
        return 0
    if options.use_stored_outcomes:
        from recipes.study.stored import summary_tables, write_stored_logs

        done = write_stored_logs(study, options.out / "stored")
        print(summary_tables(study, done))
        if not options.no_report:
            print(f"report {write_report(study, done, options.out / 'stored').files.html}")
        return 0
    done = evaluate(
        study, options.out, options.stride, options.slots, options.jobs,
        say=lambda line: print(line, flush=True),
    )  # fmt: skip
    write_outcomes(options.out / "outcomes.csv", outcomes_of(done))
    compared = compare_with_stored(study, done)
    if not options.no_report:
        print(write_report(study, done, options.out).text())
    if compared is None:
        print("no stored outcomes to compare with", file=sys.stderr)
        return 0
    print(compared.text())
    return 1 if compared.different or compared.unknown else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
