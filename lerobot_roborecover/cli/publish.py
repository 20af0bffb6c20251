"""`roborecover dataset publish`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.datasets.licenses import license_argument

if TYPE_CHECKING:
    from lerobot_roborecover.curation.publishing import PublishRequest

HELP = "Publish a dataset folder on the Hugging Face Hub, with its card, a version tag and LeRobot's tag."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("dataset", type=Path, help="the dataset's folder")
    add("--repo-id", required=True, metavar="ORG/NAME", help="where on the Hub")
    add(
        "--license",
        type=license_argument,
        help="licence by the Hub's identifier, e.g. cc-by-4.0; by default the one in the dataset's manifest",
    )
    add("--version", default="1.0.0", help="of the dataset; tag roborecover-VERSION (%(default)s)")
    add("--private", action="store_true", help="make a new repository private")
    add("--force", action="store_true", help="move the tag of a version that is published already")
    add("--title", default="", help="of the card (default: the repository's name)")
    add("--no-pictures", action="store_true", help="no grid of recovery frames in the card")
    add("--render-pictures", action="store_true", help="replay the scenarios of that grid here")
    add(
        "--anonymise", action="store_true",
        help="publish annotator-1, annotator-2, ... for names, and no comments, times and working seconds",
    )  # fmt: skip
    add("--dry-run", action="store_true", help="show what would go where, and change nothing; works offline")


def run(args: argparse.Namespace) -> int:
    """Publishes, or shows the plan."""
    from lerobot_roborecover.curation.publishing import publish_dataset

    publish_dataset(
        request(args), lambda line: print(line, flush=True), lambda line: print(line, file=sys.stderr)
    )
    return 0


def request(args: argparse.Namespace) -> PublishRequest:
    """What to publish, from parsed arguments."""
    from lerobot_roborecover.curation.publishing import PublishRequest
    from lerobot_roborecover.datasets.publish import PublishConfig

    config = PublishConfig(
        repo_id=args.repo_id,
        license=args.license,
        version=args.version,
        private=args.private,
        force=args.force,
        title=args.title,
        pictures=not args.no_pictures,
    )
    return PublishRequest(args.dataset, config, args.anonymise, args.render_pictures, args.dry_run)
