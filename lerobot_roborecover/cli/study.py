"""`roborecover study`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lerobot_roborecover.cli.old_options import renamed

HELP = (
    "Re-run a study: every policy from recovery points and from initial states, the interventions, the "
    "report, and the comparison with the stored outcomes, trial by trial."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("--name", default="metaworld", help="which study: one that ships with the package (%(default)s)")
    add("--data", type=Path, help="folder of another study")
    add("--out", type=Path, default=Path("outputs/study"), help="folder of the results (%(default)s)")
    add("--stride", type=int, default=1, metavar="N", help="take every N-th scenario only (%(default)s)")
    add("--jobs", type=int, default=0, help="runs of policies at once (0: one per core)")
    add("--slots", type=int, default=0, help="simulators at once in each (0: the cores left for it)")
    add(
        "--make", action="store_true",
        help="make the study first, from nothing but the packages: train, build, fine-tune (hours)",
    )  # fmt: skip
    add(
        "--shipped-scenarios", action="store_true",
        help="with --make: take the scenarios that come with the package instead of building them",
    )  # fmt: skip
    add("--stage", action="append", default=[], metavar="NAME", help="with --make: this stage only; again")
    add("--print", action="store_true", help="print the commands and run nothing")
    add(
        "--use-stored-outcomes", action="store_true",
        help="run nothing: print the tables, and write the report below --out/stored, of the stored outcomes",
    )  # fmt: skip
    add("--no-report", action="store_true", help="stop after the trials and the comparison")
    renamed(parser, "--stride", "--every")
    renamed(parser, "--use-stored-outcomes", "--stored")


def run(args: argparse.Namespace) -> int:
    """Evaluates, compares, reports; exit status 1 where outcomes differ from the stored ones."""
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.study.arms import arms, report_command
    from lerobot_roborecover.study.definition import read_definition, shipped_study
    from lerobot_roborecover.study.evaluate import (
        compare_with_stored,
        evaluate,
        scenario_ids,
        write_report,
    )
    from lerobot_roborecover.study.outcomes import outcomes_of, write_outcomes

    if args.stride < 1:
        raise OptionError(f"--stride={args.stride}: a count from 1")
    for name in ("jobs", "slots"):
        if getattr(args, name) < 0:
            raise OptionError(f"--{name}={getattr(args, name)}: a count; 0 follows the cores")
    if args.stage and not args.make:
        raise OptionError("--stage names a stage of --make; add --make")
    if args.shipped_scenarios and not args.make:
        raise OptionError("--shipped-scenarios is of --make; add --make")
    if args.make:
        if args.data:
            raise OptionError("--make makes its own data below --out; leave out --data")
        from lerobot_roborecover.study.make import make

        made = make(
            args.name, args.out, args.stage, lambda line: print(line, flush=True),
            shipped=args.shipped_scenarios,
        )  # fmt: skip
        if made is None:
            return 0
    study = read_definition(args.out / "data" if args.make else args.data or shipped_study(args.name))
    if args.print:
        todo = list(
            arms(study, args.out, scenario_ids(study, args.stride) if args.stride > 1 else (), args.slots)
        )
        for line in [*(a.run.command_line() for a in todo), report_command(study, todo, args.out)]:
            print(line)
        return 0
    if args.use_stored_outcomes:
        from lerobot_roborecover.study.stored import summary_tables, write_stored_logs

        done = write_stored_logs(study, args.out / "stored")
        print(summary_tables(study, done))
        if not args.no_report:
            print(f"report {write_report(study, done, args.out / 'stored').files.html}")
        return 0
    done = evaluate(
        study, args.out, args.stride, args.slots, args.jobs, say=lambda line: print(line, flush=True)
    )
    write_outcomes(args.out / "outcomes.csv", outcomes_of(done))
    compared = compare_with_stored(study, done)
    if not args.no_report:
        print(write_report(study, done, args.out).text())
    if compared is None:
        print("no stored outcomes to compare with", file=sys.stderr)
        return 0
    print(compared.text())
    return 1 if compared.different or compared.unknown else 0
