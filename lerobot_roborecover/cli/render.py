"""`roborecover dataset render`."""

from __future__ import annotations

from lerobot_roborecover.curation.render import RenderRequest

HELP = "Render every scenario's prefix as an episode, and write the whole as a LeRobotDataset."

OPTIONS = RenderRequest


def run(options: RenderRequest) -> int:
    """Renders, and says what to do with the result."""
    from lerobot_roborecover.curation.render import describe, render
    from lerobot_roborecover.utils.progress import Progress

    print(describe(options, render(options, Progress("part"))))
    return 0
