"""`roborecover dataset render`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.cli.old_options import renamed

if TYPE_CHECKING:
    from lerobot_roborecover.curation.render import RenderRequest

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
    add("--num-workers", type=int, default=1, help="processes that replay and render (%(default)s)")
    add("--work", type=Path, metavar="DIR", help="finished parts, kept between runs (OUT.parts)")
    renamed(parser, "--num-workers", "--workers")


def run(args: argparse.Namespace) -> int:
    """Renders, and says what to do with the result."""
    from lerobot_roborecover.curation.render import describe, render
    from lerobot_roborecover.utils.progress import Progress

    asked = request(args)
    print(describe(asked, render(asked, Progress("part"))))
    return 0


def request(args: argparse.Namespace) -> RenderRequest:
    """What to render, from parsed arguments."""
    from lerobot_roborecover.curation.render import RenderRequest

    return RenderRequest(args.dataset, args.out, args.frames, args.env, args.num_workers, args.work)
