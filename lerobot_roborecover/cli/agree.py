"""`roborecover curate agree`."""

from __future__ import annotations

from lerobot_roborecover.curation.agree import AgreeRequest

HELP = "Agreement between annotators, and the scenarios that their votes resolve to."

OPTIONS = AgreeRequest


def run(options: AgreeRequest) -> int:
    """Measures, resolves, and writes what was asked for."""
    from lerobot_roborecover.curation.agree import agree

    agree(options, print)
    return 0
