"""`roborecover dataset publish`."""

from __future__ import annotations

import sys

from lerobot_roborecover.curation.publishing import PublishRequest

HELP = "Publish a dataset folder on the Hugging Face Hub, with its card, a version tag and LeRobot's tag."

OPTIONS = PublishRequest


def run(options: PublishRequest) -> int:
    """Publishes, or shows the plan."""
    from lerobot_roborecover.curation.publishing import publish_dataset

    publish_dataset(options, lambda line: print(line, flush=True), lambda line: print(line, file=sys.stderr))
    return 0
