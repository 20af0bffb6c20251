"""What a build calls for each stage: the stage's own function, and the text of its result.

Lines for people go where the build's own go; those on how far a stage is go to standard error.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.curation import agree as agreeing
from lerobot_roborecover.curation import publishing
from lerobot_roborecover.curation import render as rendering
from lerobot_roborecover.curation import split_dataset as splitting
from lerobot_roborecover.curation.agree import AgreeRequest
from lerobot_roborecover.curation.annotation import automatic
from lerobot_roborecover.curation.collect import collection
from lerobot_roborecover.curation.collect.options import CollectOptions
from lerobot_roborecover.curation.publishing import PublishRequest
from lerobot_roborecover.curation.render import RenderRequest
from lerobot_roborecover.curation.screen import dataset as screening
from lerobot_roborecover.curation.screen.dataset import ScreenRequest
from lerobot_roborecover.curation.split import SplitConfig
from lerobot_roborecover.curation.validate import dataset as validation
from lerobot_roborecover.curation.validate.request import ValidationRequest
from lerobot_roborecover.utils.progress import Progress

type Say = Callable[[str], None]
"""Takes lines for people."""


def collect(options: CollectOptions, say: Say) -> None:
    """Rolls out, and says what was kept; that may be nothing."""
    say(collection.describe(collection.collect(options, _note)))


def annotate(dataset: Path, votes: Path, say: Say) -> None:
    """Has programs vote on the candidates of a dataset, into a folder."""
    automatic.annotate(dataset, say, votes=votes)


def agree(request: AgreeRequest, say: Say) -> None:
    """Resolves votes, and says how far they agree."""
    agreeing.agree(request, say)


def screen(request: ScreenRequest, say: Say) -> None:
    """Screens, and says what stays."""
    say(screening.describe(request, screening.screen_dataset(request, Progress("trial").of)))


def validate(request: ValidationRequest, say: Say) -> None:
    """Validates, and says what passes."""
    say(validation.describe(request, validation.validate_dataset(request, Progress("replay"))))


def split(root: Path, config: SplitConfig, out: Path, say: Say) -> None:
    """Divides a copy, and says how balanced it is."""
    say(splitting.describe(splitting.split_dataset(root, config, out=out), out))


def render(request: RenderRequest, say: Say) -> None:
    """Renders, and says how many episodes there are."""
    say(rendering.describe(request, rendering.render(request, Progress("part"))))


def publish(request: PublishRequest, say: Say) -> None:
    """Publishes, and says where."""
    publishing.publish_dataset(request, say, _note)


def _note(line: str) -> None:
    print(line, file=sys.stderr)


@dataclass(frozen=True)
class StageRunners:
    """The function of each stage; it returns once the stage's result is there."""

    collect: Callable[[CollectOptions, Say], None] = collect
    annotate: Callable[[Path, Path, Say], None] = annotate
    agree: Callable[[AgreeRequest, Say], None] = agree
    screen: Callable[[ScreenRequest, Say], None] = screen
    validate: Callable[[ValidationRequest, Say], None] = validate
    split: Callable[[Path, SplitConfig, Path, Say], None] = split
    render: Callable[[RenderRequest, Say], None] = render
    publish: Callable[[PublishRequest, Say], None] = publish
