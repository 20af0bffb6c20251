"""`roborecover reproduce`."""

from __future__ import annotations

import argparse
import sys
from dataclasses import fields
from pathlib import Path

from lerobot_roborecover.cli.old_options import renamed

HELP = (
    "Reproduce a published score: the initial arm first, held against what is published by its interval, "
    "then the recovery arm, and a report."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    from lerobot_roborecover.reproduce.hours import Costs

    add = parser.add_argument
    add("name", nargs="?", help="of policies/eval, or a configuration file; without: what there is")
    add("--out", type=Path, help="folder of the results; a rerun goes on there (default: outputs/NAME)")
    add("--scenarios", metavar="SET", help="folder, Hub id or shipped set (default: the configuration's)")
    add("--split", metavar="SPLIT", help="of the scenarios, e.g. test")
    add("--select", metavar="EXPR", help="of the scenarios, as --env.select")
    add("--trials", type=int, default=5, help="of each scenario in each arm (%(default)s)")
    add("--published", metavar="RATE", help="what to hold the initial arm against, in per cent: RATE or "
        "RATE,LOW,HIGH (default: the paper's)")  # fmt: skip
    add("--margin", type=float, default=10.0, metavar="POINTS",
        help="a loss that the initial arm must be able to show (%(default)s)")  # fmt: skip
    add("--force", action="store_true", help="run the recovery arm also where the initial arm is too low")
    add("--print", action="store_true", help="print commands and expected hours, and run nothing")
    for field in fields(Costs):
        add(f"--{field.name.replace('_', '-')}", type=type(field.default), default=field.default,
            help="for the expected hours alone (%(default)s)")  # fmt: skip
    add("--set", action="append", default=[], metavar="NAME=VALUE",
        help="option of roborecover eval for both arms, e.g. policy.device=cuda; again")  # fmt: skip
    renamed(parser, "--force", "--anyway")


def run(args: argparse.Namespace) -> int:
    """Runs both arms and writes the report; exit status 1 where the initial arm is below what is
    published."""
    from lerobot_roborecover.analysis.stats.agreement import AgreementVerdict
    from lerobot_roborecover.reproduce import (
        ReproductionPlan,
        find_checkpoint,
        known_names,
        run_arms,
        write_record,
    )
    from lerobot_roborecover.reproduce.arms import INITIAL, RECOVERY, published_score
    from lerobot_roborecover.reproduce.hours import Costs
    from lerobot_roborecover.reproduce.record import check_record, verdict

    if args.name is None:
        print("\n".join(known_names()))
        return 0
    checkpoint = find_checkpoint(args.name)
    chosen = [f"--env.{n}={getattr(args, n)}" for n in ("scenarios", "split", "select") if getattr(args, n)]
    plan = ReproductionPlan(
        checkpoint,
        args.out or Path("outputs") / checkpoint.name,
        args.trials,
        (*chosen, *(f"--{option}" for option in args.set)),
        published_score(args.published) if args.published else checkpoint.initial,
        args.margin / 100,
        args.force,
        Costs(**{field.name: getattr(args, field.name) for field in fields(Costs)}),
    )
    if args.print:
        scenarios = plan.scenarios()
        for start in (INITIAL, RECOVERY):
            length = plan.length(start, scenarios)
            print(f"# {start}: {length.trials} trials, at most {length.hours:.2g} hours "
                  f"(simulators {length.simulator_h:.2g}, policy {length.policy_h:.2g})")  # fmt: skip
            print(plan.command_line(start))
        return 0
    check_record(plan)
    result = run_arms(plan, say=lambda line: print(line, flush=True))
    page, _ = write_record(result)
    print(f"\n{verdict(result)}\nreport {page}", file=sys.stdout)
    return 1 if result.check.standing is AgreementVerdict.LOWER else 0
