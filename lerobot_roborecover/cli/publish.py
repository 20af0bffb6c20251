"""`roborecover publish`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.datasets.licenses import license_argument

if TYPE_CHECKING:
    import numpy as np

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
    from tempfile import TemporaryDirectory

    from lerobot_roborecover.curation.people import anonymise, find_people

    people = find_people(args.dataset)
    notes = people.lines(args.anonymise)
    if not args.anonymise:
        return _publish(args, args.dataset, str(args.dataset), notes)
    root = args.dataset.resolve()
    # Beside the dataset, on the same disk, so that its videos are linked and not copied.
    with TemporaryDirectory(prefix=".anonymised-", dir=root.parent) as folder:
        copy = Path(folder) / root.name
        left = anonymise(root, copy, people)
        notes += [f"people    a name is still in {name}: look at it before you publish" for name in left]
        return _publish(args, copy, f"{args.dataset}, anonymised", notes)


def _publish(args: argparse.Namespace, root: Path, called: str, notes: list[str]) -> int:
    """Publishes a folder, or shows the plan, with what it says of people."""
    from lerobot_roborecover.datasets.publish import PublishConfig, plan_publish, publish

    plan = plan_publish(
        root,
        PublishConfig(
            repo_id=args.repo_id,
            license=args.license,
            version=args.version,
            private=args.private,
            force=args.force,
            title=args.title,
            pictures=not args.no_pictures,
            frames=_rendered(args.dataset) if args.render_pictures else None,
            called=called,
        ),
        to_show=args.dry_run,
    )
    if args.anonymise and plan.exists:
        notes.append(
            "people    earlier commits of the repository keep what they hold: delete it to be rid of it"
        )
    print("\n".join([*plan.lines(), *notes]), flush=True)
    if args.dry_run:
        print("dry run: nothing was changed")
        return 0
    done = publish(plan, lambda n, total: print(f"uploaded  {n}/{total} files", file=sys.stderr))
    print(f"commit    {done.commit}\nurl       {done.url}")
    print(f"evaluate with --env.scenarios={args.repo_id} --env.revision={done.commit}")
    return 0


def _rendered(root: Path) -> dict[str, np.ndarray]:
    """Recovery frames of the scenarios that the card shows, by id."""
    import tempfile

    import numpy as np
    from PIL import Image

    from lerobot_roborecover.analysis.pictures import render_frames
    from lerobot_roborecover.datasets.card import GRID_TILES
    from lerobot_roborecover.datasets.pictures import spread
    from lerobot_roborecover.datasets.read import read_scenarios

    scenarios = read_scenarios(root)
    shown = [scenarios[row] for row in spread(scenarios, GRID_TILES)]
    with tempfile.TemporaryDirectory() as folder:
        files, problem = render_frames(shown, Path(folder))
        if problem:
            print(f"some recovery frames could not be rendered: {problem}", file=sys.stderr)
        return {name: np.asarray(Image.open(path).convert("RGB")) for name, path in files.items()}
