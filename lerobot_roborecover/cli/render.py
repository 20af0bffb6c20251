"""`roborecover render`."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "Render every scenario's prefix as an episode, and write the whole as a LeRobotDataset."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("dataset", type=Path, help="folder of a scenario dataset")
    add("--out", required=True, type=Path, help="folder of the new dataset; new or empty")
    add("--frames", type=int, default=256, metavar="SIZE", help="side of the pictures, pixels (%(default)s)")
    add(
        "--env", action="append", default=[], metavar="KEY=VALUE",
        help="option of the recovery env type, e.g. render_quality=fast; may be given again",
    )  # fmt: skip
    add("--workers", type=int, default=1, help="processes that replay and render (%(default)s)")
    add("--work", type=Path, metavar="DIR", help="finished parts, kept between runs (OUT.parts)")


def run(args: argparse.Namespace) -> int:
    """Renders, and says what to do with the result."""
    from lerobot_roborecover.cli.progress import Progress
    from lerobot_roborecover.curation.render import RenderRequest, render
    from lerobot_roborecover.words import counted, next_line

    request = RenderRequest(args.dataset, args.out, args.frames, args.env, args.workers, args.work)
    count = render(request, Progress("part"))
    print(f"{counted(count, 'episode')} in {args.out}")
    print(next_line(["publish", str(args.out), "--repo-id", "ORG/NAME"]))
    return 0
