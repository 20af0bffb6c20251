"""Automatic annotators at the real page, in a real browser: what it shows leads to the votes that the
recorded steps lead to."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_roborecover.curation.annotation.annotators import EYES
from lerobot_roborecover.curation.annotation.automatic import annotate
from lerobot_roborecover.curation.annotation.votes import read_votes
from lerobot_roborecover.studio.annotate.serve import AnnotateConfig, serve
from lerobot_roborecover.studio.line_process import LineProcess
from tests.support.browser import browsing
from tests.support.candidate_files import candidate_dataset
from tests.support.page_annotator import PageAnnotator

pytestmark = pytest.mark.browser

OF_THE_VISIT = ("uid", "seconds", "at")
"""What differs from one vote to another that says the same."""


def votes_at_the_page(root: Path, folder: Path, names: list[str]) -> dict[str, dict[str, dict]]:
    """Has annotators vote at the page, and reads what the server wrote: by annotator and candidate."""
    config = AnnotateConfig(root, names, port=0, votes=folder, examples=False)
    with LineProcess("the annotation server", serve, config) as server, browsing() as visit:
        for name in names:
            page, complaints = visit((server.hear() or "").split()[-1])
            page.wait_for_selector("#guide[open]")
            page.keyboard.press("g")
            page.wait_for_selector("#guide:not([open])", state="attached")
            PageAnnotator(page, EYES[name]).annotate_all()
            assert not complaints
            page.context.close()
    return by_candidate(folder)


def by_candidate(folder: Path) -> dict[str, dict[str, dict]]:
    """What was marked, by annotator and candidate."""
    return {
        name: {r["candidate"]: {k: v for k, v in r.items() if k not in OF_THE_VISIT} for r in records}
        for name, records in read_votes(folder).items()
    }


def compare(root: Path, tmp_path: Path, names: list[str]) -> None:
    """Both ways, with equal votes."""
    annotate(root, print, annotators=names, votes=tmp_path / "direct")
    direct = by_candidate(tmp_path / "direct")
    assert votes_at_the_page(root, tmp_path / "page", names) == direct


def test_the_page_shows_what_the_steps_say(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    compare(candidate_dataset(tmp_path / "rollouts", 5), tmp_path, ["auto-1"])


@pytest.mark.nightly
@pytest.mark.parametrize("steps", [30, 61, 120])
def test_the_page_shows_what_the_steps_say_to_every_annotator(tmp_path, monkeypatch, steps):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    compare(candidate_dataset(tmp_path / "rollouts", 12, steps=steps), tmp_path, list(EYES))
