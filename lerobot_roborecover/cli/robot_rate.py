"""`roborecover robot rate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.options import option

HELP = "Rate a run's trials a second time from their recordings, blind, and measure the agreement."


@dataclass(frozen=True, kw_only=True)
class RobotRateOptions:
    """Which run, and who rates."""

    run: Path = option(positional=True, metavar="RUN")
    """Folder of a run of `roborecover robot run`."""
    rater: str = ""
    """Pseudonym of the rater. Without one, the agreement so far is printed."""
    host: str = "127.0.0.1"
    """Where the page is served; 0.0.0.0 lets a phone on the same network in."""
    port: int = 8734
    """0 takes a free port."""
    seed: int = 0
    """Seed of the order in which trials are shown."""


OPTIONS = RobotRateOptions


def run(options: RobotRateOptions) -> int:
    """Serves the page until every trial is rated, then prints the agreement."""
    from lerobot_roborecover.robot.rate import agreement_text, rate

    if options.rater:
        rate(options.run, options.rater, options.seed, options.host, options.port, print)
    print(agreement_text(options.run))
    return 0
