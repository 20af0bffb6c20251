"""`roborecover curate annotate`."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_roborecover.web.annotate.serve import AnnotateConfig, serve

HELP = "Mark recovery points, stages and types in a local web page, each annotator alone and blind."


@dataclass(frozen=True, kw_only=True)
class AnnotateOptions(AnnotateConfig):
    """One annotation session, of people or of programs."""

    automatic: bool = False
    """No people: three programs apply written rules to the recorded steps; their labels are marked as
    automatic wherever they go."""


OPTIONS = AnnotateOptions


def run(options: AnnotateOptions) -> int:
    """Serves the page until interrupted, or has programs annotate."""
    from lerobot_roborecover.curation.annotation.annotators import PREFIX, is_automatic
    from lerobot_roborecover.curation.annotation.automatic import annotate
    from lerobot_roborecover.scenario import ScenarioError

    reserved = [name for name in options.annotators if is_automatic(name)]
    if reserved:
        raise ScenarioError(
            f"--annotator {reserved[0]}: names that start with {PREFIX!r} are those of automatic annotators. "
            "Take another, or --automatic"
        )
    if bool(options.annotators) == options.automatic:
        raise ScenarioError("name who annotates with --annotator NAME, or say --automatic")
    try:
        if options.automatic:
            annotate(options.dataset, _say, votes=options.votes, only=options.only)
        else:
            serve(options, _say)
    except KeyboardInterrupt:
        # The way to end it; every vote is on disk already.
        print("stopped")
    return 0


def _say(line: str) -> None:
    print(line, flush=True)
