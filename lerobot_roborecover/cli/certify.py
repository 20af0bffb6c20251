"""`roborecover dataset certify`."""

from __future__ import annotations

from lerobot_roborecover.curation.certification import CertifyOptions

HELP = (
    "Replay every scenario of a set in two fresh processes and from a snapshot, compare with what was "
    "recorded, and write a certificate beside the set; status 1 where something is not exact."
)
OPTIONS = CertifyOptions


def run(options: CertifyOptions) -> int:
    """Certifies and prints the table; 1 when a scenario is not exact."""
    from lerobot_roborecover.curation.certification import certify, describe
    from lerobot_roborecover.utils.progress import Progress

    done = certify(options, Progress("replay"))
    print(describe(done))
    return int(bool(done.certificate.inexact))
