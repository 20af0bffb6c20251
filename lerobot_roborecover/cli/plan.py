"""`roborecover plan`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.options import option

HELP = (
    "Plan an evaluation before it is run: how many scenarios and trials separate two policies that differ by "
    "so many points, and the least difference that a set at hand can show."
)


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """What is believed of two policies, and what is asked."""

    pilot: tuple[str, ...] = option((), metavar="[NAME=]LOG")
    """Trial log of one policy or two, for rate, scatter and correlation; may be given again."""
    rate: float | None = option(None, metavar="PERCENT")
    """Success rate of the worse policy (default: the pilot's)."""
    sd: float | None = option(None, metavar="POINTS")
    """Standard deviation of a policy's true rates between scenarios (default: the pilot's, else that of a
    third of the greatest variance)."""
    correlation: float | None = None
    """Correlation of the two policies' true rates over scenarios (default: the pilot's, else 0.5)."""
    difference: tuple[float, ...] | None = option(None, nargs="+", metavar="POINTS")
    """True differences to plan for (default: 5 10 15 20, as far as the rate leaves room)."""
    trials: tuple[int, ...] = option((1, 2, 3, 4, 5), nargs="+", metavar="K")
    """Trials of a scenario (default: 1 to 5)."""
    scenarios: str | None = option(None, metavar="N|SET")
    """Scenarios at hand, a number or a set (shipped name, folder, Hub id): the least difference that they can
    show."""
    revision: str | None = None
    """Commit, tag or branch of that set on the Hub."""
    split: str | None = None
    """Split of that set."""
    power: float = option(80, metavar="PERCENT")
    """Wanted chance."""
    level: float = 0.95
    """Confidence level."""
    family: int = option(1, metavar="PAIRS")
    """Pairs that p will be adjusted for: 15 for six policies."""
    robot_minutes: float | None = option(None, metavar="MINUTES")
    """Minutes of a trial on a robot, its reset included, to see the hours; scenarios are recovery points."""
    out: Path | None = option(None, metavar="DIR")
    """Folder for the tables (CSV, Markdown) and the figure."""


OPTIONS = PlanOptions


def run(options: PlanOptions) -> int:
    """Prints the plan, and writes it where asked."""
    from lerobot_roborecover.analysis.figures.plan import detectable_figure
    from lerobot_roborecover.analysis.figures.style import png_of, svg_of
    from lerobot_roborecover.analysis.plan_tables import detectable_table, plan_table
    from lerobot_roborecover.analysis.stats.power import plans
    from lerobot_roborecover.analysis.tables import to_csv, to_markdown, to_text
    from lerobot_roborecover.utils.atomic_io import atomic_write
    from lerobot_roborecover.utils.outputs import check_page

    _check(options)
    guess, remarks = _guess(options)
    wanted, trials, given = options.power / 100, sorted(set(options.trials)), options.difference
    room = 1 - guess.rate
    differences = [d / 100 for d in given] if given else [d for d in (0.05, 0.1, 0.15, 0.2) if d < room]
    common = wanted, options.level, options.family
    tables = []
    at = None
    if options.scenarios is not None:
        at, shared = _scenarios(options, options.scenarios)
        remarks += shared
    if at is not None:
        tables.append(detectable_table(guess, at, trials, *common))
    if at is None or given:
        tables.append(
            plan_table(plans(guess, differences, trials, *common), guess, *common, options.robot_minutes)
        )
    for table in tables:
        print(f"{table.title}\n\n{to_text(table)}\n")
    for remark in remarks:
        print(f"note: {remark}", file=sys.stderr)
    if options.out is not None:
        files = ("plan.md", "plan.svg", "plan.png", *(f"{table.name}.csv" for table in tables))
        check_page(options.out, files, lambda page: b"](plan.svg)" in page.read_bytes())
        figure = detectable_figure(guess, trials, *common, at=at, differences=differences)
        text = f"![{figure.title}](plan.svg)\n\n" + "\n".join(to_markdown(table) for table in tables)
        atomic_write(options.out / "plan.md", text)
        for table in tables:
            atomic_write(options.out / f"{table.name}.csv", to_csv(table))
        atomic_write(options.out / "plan.svg", svg_of(figure.plot))
        atomic_write(options.out / "plan.png", png_of(figure.plot))
        print(f"plan      {options.out / 'plan.md'}\nfigure    {options.out / 'plan.svg'}")
    return 0


def _check(options: PlanOptions) -> None:
    from lerobot_roborecover.analysis.stats.estimators import RowsError

    if not 5 <= options.power < 100:
        raise RowsError(f"--power={options.power:g} is not a chance from 5 to below 100 per cent")
    if options.robot_minutes is not None and not 0 < options.robot_minutes <= 1440:
        raise RowsError(f"--robot-minutes={options.robot_minutes:g} is not from 0 to 1440 minutes")
    if not 0.5 <= options.level < 1:
        raise RowsError(f"--level={options.level:g} is not a confidence level from 0.5 to below 1")
    if not 1 <= options.family <= 1_000_000:
        raise RowsError(f"--family={options.family} is not a number of pairs from 1 to a million")
    for k in options.trials:
        if not 1 <= k <= 1000:
            raise RowsError(f"--trials {k}: a scenario has from 1 to 1000 trials")


def _guess(options: PlanOptions):
    """What is believed, and what to know about it."""
    from lerobot_roborecover.analysis.logs import read_study
    from lerobot_roborecover.analysis.stats.estimators import RowsError
    from lerobot_roborecover.analysis.stats.panel import make_panel
    from lerobot_roborecover.analysis.stats.power import PowerAssumptions, guess_from
    from lerobot_roborecover.analysis.stats.units import ResamplingUnit
    from lerobot_roborecover.scenario import Start

    rate = None if options.rate is None else options.rate / 100
    if not options.pilot:
        if rate is None:
            raise RowsError("neither --pilot nor --rate: say what success rate to expect of the worse policy")
        sd = (options.sd or 0) / 100
        if options.sd is None and 0 < rate < 1:
            sd = (rate * (1 - rate) / 3) ** 0.5
        return PowerAssumptions(rate, sd, 0.5 if options.correlation is None else options.correlation), []
    study = read_study(options.pilot)
    arms = study.of(Start.RECOVERY)
    if not 1 <= len(arms) <= 2:
        names = ", ".join(arm.title for arm in arms) or "none"
        raise RowsError(
            f"--pilot: the logs have {len(arms)} policies from recovery points ({names}); a plan takes one "
            "or two. Name those logs alone"
        )
    panel = make_panel(arms)
    guess = guess_from(panel, rate, options.correlation)
    if options.sd is not None:
        guess = PowerAssumptions(guess.rate, options.sd / 100, guess.correlation)
    remarks = list(study.remarks)
    if panel.unit() is not ResamplingUnit.SCENARIO:
        remarks.append(
            f"{study.platform} resamples {panel.unit().value} clusters: read clusters for scenarios"
        )
    return guess, remarks


def _scenarios(options: PlanOptions, text: str) -> tuple[int, list[str]]:
    """How many there are: a number, or those of a set; and what to know about them."""
    from lerobot_roborecover.analysis.stats.estimators import RowsError

    if text.lstrip("-").isdigit() and not Path(text).exists():
        if not 6 <= int(text) <= 1_000_000:
            raise RowsError(
                f"--scenarios={text} is not from 6 to a million: below six that differ no test can tell"
            )
        return int(text), []
    from lerobot_roborecover.datasets import load_scenarios

    found = load_scenarios(text, revision=options.revision, split=options.split)
    states = len({scenario.first_state_sha256() for scenario in found})
    if states == len(found):
        return len(found), []
    return len(found), [
        f"the {len(found)} scenarios branch off from {states} first states: a comparison from initial states "
        f"has {states} units (--scenarios {states})"
    ]
