"""`roborecover reproduce`."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.reproduce.hours import Costs
from lerobot_roborecover.utils.options import option

HELP = (
    "Reproduce a published score: the initial arm first, held against what is published by its interval, "
    "then the recovery arm, and a report."
)


@dataclass(frozen=True, kw_only=True)
class ReproduceOptions:
    """What to reproduce, and on which scenarios."""

    name: str | None = option(None, positional=True)
    """Name in policies/eval, or a configuration file; without it, the names are printed."""
    out: Path | None = None
    """Folder of the results; a rerun goes on there (default: outputs/NAME)."""
    scenarios: str | None = option(None, metavar="SET")
    """Folder, Hub id or shipped set (default: the configuration's)."""
    split: str | None = option(None, metavar="SPLIT")
    """Split of the scenarios, e.g. test."""
    select: str | None = option(None, metavar="EXPR")
    """Of the scenarios, as --env.select."""
    trials: int = 5
    """Trials of each scenario in each arm."""
    published: str | None = option(None, metavar="RATE")
    """What to hold the initial arm against, in per cent: RATE or RATE,LOW,HIGH (default: the paper's)."""
    margin: float = option(10.0, metavar="POINTS")
    """A loss that the initial arm must be able to show."""
    force: bool = option(False, old=("anyway",))
    """Run the recovery arm also where the initial arm is too low."""
    print: bool = False
    """Print commands and expected hours, and run nothing."""
    costs: Costs = field(default_factory=Costs)
    settings: tuple[str, ...] = option((), name="set", metavar="NAME=VALUE")
    """Option of roborecover eval for both arms, e.g. policy.device=cuda; again."""


OPTIONS = ReproduceOptions


def run(options: ReproduceOptions) -> int:
    """Runs both arms and writes the report; exit status 1 where the initial arm is below what is
    published, or was not measured."""
    from lerobot_roborecover.reproduce import (
        ReproductionPlan,
        find_checkpoint,
        known_names,
        run_arms,
        write_record,
    )
    from lerobot_roborecover.reproduce.arms import INITIAL, RECOVERY, STOPS, published_score
    from lerobot_roborecover.reproduce.record import check_record, verdict

    if options.name is None:
        print("\n".join(known_names()))
        return 0
    checkpoint = find_checkpoint(options.name)
    which = {name: getattr(options, name) for name in ("scenarios", "split", "select")}
    chosen = [f"--env.{name}={value}" for name, value in which.items() if value]
    plan = ReproductionPlan(
        checkpoint,
        options.out or Path("outputs") / checkpoint.name,
        options.trials,
        (*chosen, *(f"--{one}" for one in options.settings)),
        published_score(options.published) if options.published else checkpoint.initial,
        options.margin / 100,
        options.force,
        options.costs,
    )
    if options.print:
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
    return int(result.check.standing in STOPS)
