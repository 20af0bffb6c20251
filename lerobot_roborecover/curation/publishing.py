"""`roborecover dataset publish`: a dataset folder on the Hub, with or without what it says of people."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.curation.people import anonymise, find_people
from lerobot_roborecover.datasets.publish import PublishConfig
from lerobot_roborecover.utils.options import option
from lerobot_roborecover.utils.temporary import TemporaryFolder

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class PublishRequest:
    """What to publish and how."""

    dataset: Path = option(positional=True)
    """The dataset's folder."""
    config: PublishConfig = option()
    """Where to, and as what; pictures and what the plan calls the dataset are filled in here."""
    render_pictures: bool = False
    """Replay the scenarios of that grid here."""
    anonymise: bool = False
    """Publish annotator-1, annotator-2, ... for names, and no comments, times and working seconds."""
    dry_run: bool = False
    """Show what would go where, and change nothing; works offline."""


def publish_dataset(request: PublishRequest, say: Callable[[str], None], note: Callable[[str], None]) -> None:
    """Publishes, or shows the plan.

    Args:
        request: what and how.
        say: takes lines for people: the plan, and what was published.
        note: takes lines on how far it is.

    Raises:
        ScenarioError: the dataset cannot be published as it is, or the Hub refuses or does not answer.
    """
    people = find_people(request.dataset)
    notes = people.lines(request.anonymise)
    if not request.anonymise:
        _publish(request, request.dataset, str(request.dataset), notes, say, note)
        return
    root = request.dataset.resolve()
    # Beside the dataset, on the same disk, so that its videos are linked and not copied.
    with TemporaryFolder("copy", root.parent, ".anonymised-") as folder:
        copy = folder / root.name
        left = anonymise(root, copy, people)
        notes += [f"people    a name is still in {name}: look at it before you publish" for name in left]
        _publish(request, copy, f"{request.dataset}, anonymised", notes, say, note)


def _publish(
    request: PublishRequest,
    root: Path,
    called: str,
    notes: list[str],
    say: Callable[[str], None],
    note: Callable[[str], None],
) -> None:
    """Publishes a folder, or shows the plan, with what it says of people."""
    from lerobot_roborecover.datasets.publish import plan_publish, publish

    frames = _rendered(request.dataset, note) if request.render_pictures else None
    config = replace(request.config, frames=frames, called=called)
    plan = plan_publish(root, config, to_show=request.dry_run)
    if request.anonymise and plan.exists:
        notes.append(
            "people    earlier commits of the repository keep what they hold: delete it to be rid of it"
        )
    say("\n".join([*plan.lines(), *notes]))
    if request.dry_run:
        say("dry run: nothing was changed")
        return
    done = publish(plan, lambda n, total: note(f"uploaded  {n}/{total} files"))
    say(f"commit    {done.commit}\nurl       {done.url}")
    say(f"evaluate with --env.scenarios={config.repo_id} --env.revision={done.commit}")


def _rendered(root: Path, note: Callable[[str], None]) -> dict[str, np.ndarray]:
    """Recovery frames of the scenarios that the card shows, by id."""
    import numpy as np
    from PIL import Image

    from lerobot_roborecover.analysis.pages.pictures import render_frames
    from lerobot_roborecover.datasets.card import GRID_TILES
    from lerobot_roborecover.datasets.pictures import spread
    from lerobot_roborecover.datasets.read import read_scenarios

    scenarios = read_scenarios(root)
    shown = [scenarios[row] for row in spread(scenarios, GRID_TILES)]
    with TemporaryFolder("frames") as folder:
        files, problem = render_frames(shown, folder)
        if problem:
            note(f"some recovery frames could not be rendered: {problem}")
        return {name: np.asarray(Image.open(path).convert("RGB")) for name, path in files.items()}
