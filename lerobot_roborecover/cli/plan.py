"""`roborecover plan`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

HELP = (
    "Plan an evaluation before it is run: how many scenarios and trials separate two policies that differ by "
    "so many points, and the least difference that a set at hand can show."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add(
        "--pilot",
        action="append",
        default=[],
        metavar="[NAME=]LOG",
        help="trial log of one policy or two, for rate, scatter and correlation; may be given again",
    )
    add(
        "--rate",
        type=float,
        metavar="PERCENT",
        help="success rate of the worse policy (default: the pilot's)",
    )
    add(
        "--sd",
        type=float,
        metavar="POINTS",
        help="standard deviation of a policy's true rates between scenarios (default: the pilot's, else that "
        "of a third of the greatest variance)",
    )
    add(
        "--correlation",
        type=float,
        help="of the two policies' true rates over scenarios (default: the pilot's, else 0.5)",
    )
    add(
        "--difference",
        type=float,
        nargs="+",
        metavar="POINTS",
        help="true differences to plan for (default: 5 10 15 20, as far as the rate leaves room)",
    )
    add(
        "--trials",
        type=int,
        nargs="+",
        default=[1, 2, 3, 4, 5],
        metavar="K",
        help="trials of a scenario (default: 1 to 5)",
    )
    add(
        "--scenarios",
        metavar="N|SET",
        help="scenarios at hand, a number or a set (shipped name, folder, Hub id): the least difference that "
        "they can show",
    )
    add("--revision", help="commit, tag or branch of that set on the Hub")
    add("--split", help="split of that set")
    add("--power", type=float, default=80.0, metavar="PERCENT", help="wanted chance (%(default)g)")
    add("--level", type=float, default=0.95, help="confidence level (%(default)s)")
    add(
        "--family",
        type=int,
        default=1,
        metavar="PAIRS",
        help="pairs that p will be adjusted for: 15 for six policies (%(default)s)",
    )
    add("--out", type=Path, metavar="DIR", help="folder for the tables (CSV, Markdown) and the figure")


def run(args: argparse.Namespace) -> int:
    """Prints the plan, and writes it where asked."""
    from lerobot_roborecover.analysis.figures.plan import detectable_figure
    from lerobot_roborecover.analysis.figures.style import png_of, svg_of
    from lerobot_roborecover.analysis.plan_tables import detectable_table, plan_table
    from lerobot_roborecover.analysis.stats.power import plans
    from lerobot_roborecover.analysis.tables import to_csv, to_markdown, to_text
    from lerobot_roborecover.utils.atomic_io import atomic_write
    from lerobot_roborecover.utils.outputs import check_page

    _check(args)
    guess, remarks = _guess(args)
    wanted, trials, given = args.power / 100, sorted(set(args.trials)), args.difference
    room = 1 - guess.rate
    differences = [d / 100 for d in given] if given else [d for d in (0.05, 0.1, 0.15, 0.2) if d < room]
    common = wanted, args.level, args.family
    tables = []
    at = None
    if args.scenarios is not None:
        at, shared = _scenarios(args)
        remarks += shared
    if at is not None:
        tables.append(detectable_table(guess, at, trials, *common))
    if at is None or given:
        tables.append(plan_table(plans(guess, differences, trials, *common), guess, *common))
    for table in tables:
        print(f"{table.title}\n\n{to_text(table)}\n")
    for remark in remarks:
        print(f"note: {remark}", file=sys.stderr)
    if args.out is not None:
        files = ("plan.md", "plan.svg", "plan.png", *(f"{table.name}.csv" for table in tables))
        check_page(args.out, files, lambda page: b"](plan.svg)" in page.read_bytes())
        figure = detectable_figure(guess, trials, *common, at=at, differences=differences)
        text = f"![{figure.title}](plan.svg)\n\n" + "\n".join(to_markdown(table) for table in tables)
        atomic_write(args.out / "plan.md", text)
        for table in tables:
            atomic_write(args.out / f"{table.name}.csv", to_csv(table))
        atomic_write(args.out / "plan.svg", svg_of(figure.plot))
        atomic_write(args.out / "plan.png", png_of(figure.plot))
        print(f"plan      {args.out / 'plan.md'}\nfigure    {args.out / 'plan.svg'}")
    return 0


def _check(args: argparse.Namespace) -> None:
    from lerobot_roborecover.analysis.stats.estimators import RowsError

    if not 5 <= args.power < 100:
        raise RowsError(f"--power={args.power:g} is not a chance from 5 to below 100 per cent")
    if not 0.5 <= args.level < 1:
        raise RowsError(f"--level={args.level:g} is not a confidence level from 0.5 to below 1")
    if not 1 <= args.family <= 1_000_000:
        raise RowsError(f"--family={args.family} is not a number of pairs from 1 to a million")
    for k in args.trials:
        if not 1 <= k <= 1000:
            raise RowsError(f"--trials {k}: a scenario has from 1 to 1000 trials")


def _guess(args: argparse.Namespace):
    """What is believed, and what to know about it."""
    from lerobot_roborecover.analysis.logs import read_study
    from lerobot_roborecover.analysis.stats.estimators import RowsError
    from lerobot_roborecover.analysis.stats.panel import make_panel
    from lerobot_roborecover.analysis.stats.power import PowerAssumptions, guess_from
    from lerobot_roborecover.analysis.stats.units import ResamplingUnit
    from lerobot_roborecover.scenario import Start

    rate = None if args.rate is None else args.rate / 100
    if not args.pilot:
        if rate is None:
            raise RowsError("neither --pilot nor --rate: say what success rate to expect of the worse policy")
        sd = (rate * (1 - rate) / 3) ** 0.5 if args.sd is None and 0 < rate < 1 else (args.sd or 0) / 100
        return PowerAssumptions(rate, sd, 0.5 if args.correlation is None else args.correlation), []
    study = read_study(args.pilot)
    arms = study.of(Start.RECOVERY)
    if not 1 <= len(arms) <= 2:
        names = ", ".join(arm.title for arm in arms) or "none"
        raise RowsError(
            f"--pilot: the logs have {len(arms)} policies from recovery points ({names}); a plan takes one "
            "or two. Name those logs alone"
        )
    panel = make_panel(arms)
    guess = guess_from(panel, rate, args.correlation)
    if args.sd is not None:
        guess = PowerAssumptions(guess.rate, args.sd / 100, guess.correlation)
    remarks = list(study.remarks)
    if panel.unit() is not ResamplingUnit.SCENARIO:
        remarks.append(
            f"{study.platform} resamples {panel.unit().value} clusters: read clusters for scenarios"
        )
    return guess, remarks


def _scenarios(args: argparse.Namespace) -> tuple[int, list[str]]:
    """How many there are: a number, or those of a set; and what to know about them."""
    from lerobot_roborecover.analysis.stats.estimators import RowsError

    text = args.scenarios
    if text.lstrip("-").isdigit() and not Path(text).exists():
        if not 6 <= int(text) <= 1_000_000:
            raise RowsError(
                f"--scenarios={text} is not from 6 to a million: below six that differ no test can tell"
            )
        return int(text), []
    from lerobot_roborecover.datasets import load_scenarios

    found = load_scenarios(text, revision=args.revision, split=args.split)
    states = len({scenario.first_state_sha256() for scenario in found})
    if states == len(found):
        return len(found), []
    return len(found), [
        f"the {len(found)} scenarios branch off from {states} first states: a comparison from initial states "
        f"has {states} units (--scenarios {states})"
    ]
