"""`curate agree`: from votes on a candidate dataset to agreement, a list to discuss, and scenarios."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.curation.agreement import format_agreement
from lerobot_roborecover.curation.annotation.votes import votes_folder
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.funnel import attrition_table, count_stages, read_decisions
from lerobot_roborecover.curation.resolution import (
    NOT_PEOPLES,
    Resolution,
    ResolutionConfig,
    resolve,
    write_discussion,
    write_resolution,
)
from lerobot_roborecover.datasets.licenses import license_argument
from lerobot_roborecover.utils.options import option
from lerobot_roborecover.utils.text import next_command, pluralize


@dataclass(frozen=True)
class AgreeRequest:
    """Which votes to resolve, how, and what to write."""

    dataset: Path = option(positional=True)
    """Folder of the candidate dataset that was annotated."""
    votes: Path | None = option(None, metavar="FOLDER")
    """Of all votes (DATASET/meta/roborecover/votes)."""
    config: ResolutionConfig = field(default_factory=ResolutionConfig)
    discuss: Path | None = option(None, metavar="LIST")
    """Write them to this file, for `annotate --only`."""
    out: Path | None = option(None, metavar="FOLDER")
    """Write the resolved candidates as a scenario dataset."""
    license: str | None = option(None, parse=license_argument)
    """Licence by the Hub's identifier, of that dataset."""


def agree(request: AgreeRequest, say: Callable[[str], None]) -> Resolution:
    """Measures, resolves, and writes what was asked for.

    Args:
        request: which votes, and what to write.
        say: takes lines for people: agreement, outcomes, what was written, and the command that follows.

    Raises:
        ScenarioError: candidates or votes cannot be read, or no candidate is resolved to a scenario.
    """
    candidates = read_candidates(request.dataset)
    found = resolve(candidates, votes_folder(request.dataset, request.votes), request.config)
    counts = found.counts()
    say(
        f"{pluralize(len(found.annotators), 'annotator')}: {', '.join(found.annotators)}; "
        f"round {found.rounds}"
    )
    if NOT_PEOPLES[found.kind]:
        say(NOT_PEOPLES[found.kind])
    say(format_agreement(found.agreement))
    say(", ".join(f"{n} {outcome}" for outcome, n in sorted(counts.items())))
    if request.discuss:
        listed = write_discussion(request.discuss, found)
        say(f"{pluralize(listed, 'candidate')} to discuss" + (f" in {request.discuss}" if listed else ""))
    if request.out:
        write_resolution(request.out, candidates, found, request.config, license=request.license)
        say(f"{pluralize(counts['kept'], 'scenario')} in {request.out}")
        say(attrition_table(count_stages(read_decisions(request.out))))
        say(
            next_command(
                ["curate", "screen", str(request.out), "--policy", "CHECKPOINT", "--out", "SCREENED"]
            )
        )
    return found
