"""`roborecover detect fork`."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass, replace

from lerobot_roborecover.detection.forks.run import ForkRequest, run_forks
from lerobot_roborecover.utils.options import option

HELP = (
    "Continue logged trials from some of their steps in several ways, and say what each gains over going on: "
    "recovery gain = P(success | intervene) - P(success | continue)."
)


@dataclass(frozen=True, kw_only=True)
class ForkOptions(ForkRequest):
    """Which trials are forked, and how; the arms as they are written on a command line."""

    arm: tuple[str, ...] = option((), metavar="ARM")
    """What to do at a fork, beside going on: fresh, rollback:K, correction:CHECKPOINT, policy:CHECKPOINT,
    human:MODULE:FUNCTION; may be given again (fresh and rollback:30)."""


OPTIONS = ForkOptions


def run(options: ForkOptions) -> int:
    """Runs the forks, writes the page, prints the gains."""
    from lerobot_roborecover.analysis.pages.fork_gain import PAGE, reproduced_text, write_gains
    from lerobot_roborecover.analysis.stats.fork_gain import fork_gains
    from lerobot_roborecover.analysis.tables import to_text
    from lerobot_roborecover.detection.forks.arms import parse_arm
    from lerobot_roborecover.utils.progress import Progress

    arms = [parse_arm(text) for text in dict.fromkeys(options.arm or ("fresh", "rollback:30"))]
    request = replace(options, arms=arms)
    result = run_forks(request, Progress("fork").of)
    for reason, count in result.dropped.most_common():
        print(f"note: {count} trials not forked: {reason}", file=sys.stderr)
    gains = fork_gains(result.rows)
    tables = write_gains(gains, options.out, shlex.join(["roborecover", *sys.argv[1:]]))
    print("\n\n".join(f"{table.title}\n{to_text(table)}" for table in tables[:3]))
    print(f"\n{reproduced_text(gains)}\nlog {result.log}\npage {options.out / PAGE}")
    same, of = gains.reproduced
    if same != of and options.deterministic:
        print(
            f"error: {options.policy} is said to be deterministic, and {of - same} of {of} of its trials end "
            "otherwise on another random stream: what is above is wrong. Leave out --deterministic, and name "
            "another --out",
            file=sys.stderr,
        )
    return 0 if same == of else 1
