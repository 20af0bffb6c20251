"""`roborecover compare`."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

from lerobot_roborecover.cli.report import LogOptions
from lerobot_roborecover.utils.options import option

HELP = (
    "Compare two policies from their trial logs: difference, interval, adjusted p, where it comes "
    "from, and a "
    "verdict in words. Refuses logs that cannot be compared."
)


@dataclass(frozen=True, kw_only=True)
class CompareOptions(LogOptions):
    """Which two policies to compare."""

    a: str | None = option(None, metavar="NAME")
    """First policy, where the logs hold more than two."""
    b: str | None = option(None, metavar="NAME")
    """Second policy."""
    sequential: bool = False
    """The logs are still growing, and looked at more than once: p and interval hold at every look."""
    scenarios: str | None = None
    """With --sequential: the set that the runs were to evaluate (shipped name, folder, Hub id) where the logs
    do not name all of it yet."""
    revision: str | None = None
    """Commit, tag or branch of that set on the Hub."""
    select: str = ""
    """The runs' --env.select."""
    json: bool = False
    """Print JSON."""


OPTIONS = CompareOptions


def run(options: CompareOptions) -> int:
    from lerobot_roborecover.analysis.compare import compare, to_json, to_screen
    from lerobot_roborecover.analysis.logs import read_study
    from lerobot_roborecover.analysis.sequential_plan import planned_units
    from lerobot_roborecover.analysis.stats.estimators import RowsError

    if options.scenarios and not options.sequential:
        raise RowsError(
            f"--scenarios {options.scenarios} says what --sequential plans for; give both or neither"
        )
    study, planned = read_study(options.logs, options.platform), None
    if options.scenarios:
        planned = planned_units(study, options.scenarios, options.revision, options.select)
    how = replace(options.analysis, sequential=options.sequential, planned=planned)
    found = compare(study, options.a, options.b, how)
    print(json.dumps(to_json(found), indent=1) if options.json else to_screen(found))
    return 0
