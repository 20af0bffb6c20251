"""Automatic annotators at the real page, in a real browser: what it shows leads to the votes that the
recorded steps lead to."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import pytest

from lerobot_roborecover.curation.annotation.annotators import LABELERS
from lerobot_roborecover.curation.annotation.automatic import annotate, reading, sheet_of
from lerobot_roborecover.curation.annotation.features import EpisodeFeatures
from lerobot_roborecover.curation.annotation.frames import Videos
from lerobot_roborecover.curation.annotation.shown import Shown, shown
from lerobot_roborecover.curation.annotation.votes import read_votes
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.web.annotate.identity import names_of
from lerobot_roborecover.web.annotate.serve import AnnotateConfig, serve
from lerobot_roborecover.web.background_server import BackgroundServer
from tests.support.browser import browsing
from tests.support.candidate_files import candidate_dataset
from tests.support.page_annotator import READ, PageAnnotator

pytestmark = pytest.mark.browser

OF_THE_VISIT = ("uid", "seconds", "at")
"""What differs from one vote to another that says the same."""


def vote_at_the_page(root: Path, folder: Path, names: list[str]) -> list[EpisodeFeatures]:
    """Has annotators vote at the page, into a folder; what they saw there."""
    looks: list[EpisodeFeatures] = []
    config = AnnotateConfig(root, names, port=0, votes=folder, examples=False)
    with BackgroundServer("the annotation server", serve, config) as server, browsing() as visit:
        for name in names:
            page, complaints = visit((server.hear() or "").split()[-1])
            page.wait_for_selector("#guide[open]")
            page.keyboard.press("g")
            page.wait_for_selector("#guide:not([open])", state="attached")
            annotator = PageAnnotator(page, LABELERS[name])
            annotator.annotate_all()
            looks += annotator.looks
            assert not complaints
            page.context.close()
    return looks


def by_candidate(folder: Path) -> dict[str, dict[str, dict]]:
    """What was marked, by annotator and candidate."""
    return {
        name: {r["candidate"]: {k: v for k, v in r.items() if k not in OF_THE_VISIT} for r in records}
        for name, records in read_votes(folder).items()
    }


def compare(root: Path, tmp_path: Path, names: list[str]) -> None:
    """Annotates both ways: the same numbers, the same votes."""
    annotate(root, print, annotators=names, votes=tmp_path / "direct")
    looks = vote_at_the_page(root, tmp_path / "page", names)
    assert by_candidate(tmp_path / "page") == by_candidate(tmp_path / "direct")
    candidates, fps = read_candidates(root), Videos(root).fps
    called = names_of(candidates, tmp_path / "page")
    assert len(looks) == len(candidates) * len(names)
    for look in looks:
        number = candidates.by_id[called.candidates[look.sheet.candidate]]
        episode = shown(candidates, number, fps)
        assert look.sheet == sheet_of(look.sheet.candidate, episode, fps)
        assert look.readings == {frame: reading(episode, frame) for frame in look.readings}


def test_the_page_shows_what_the_steps_say(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    compare(candidate_dataset(tmp_path / "rollouts", 2), tmp_path, ["auto-1"])


@pytest.mark.nightly
def test_every_row_of_the_readout_is_read(tmp_path, monkeypatch):
    """Grippers, goals and speeds of objects, which the toy has not; and numbers in the middle of two."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    whole = {"reach": [0.0625], "goal": [0.1875], "moved": [1.0015], "height": [-0.0625]}
    episode = Shown(
        "do it", 1, 1, False, False, {"x": [0.5]}, {"gripper": [-1.0], "left gripper": [0.0005]}, [0.3125],
        {"black bowl 1": [0.0015]}, {"black bowl 1": whole, "plate": {**whole, "goal": None}},
    )  # fmt: skip
    config = AnnotateConfig(candidate_dataset(tmp_path / "set", 1), ["auto-1"], port=0, examples=False)
    with BackgroundServer("the annotation server", serve, config) as server, browsing() as visit:
        page, _ = visit((server.hear() or "").split()[-1])
        page.wait_for_selector("#cameras canvas[data-episode]", state="attached")
        page.evaluate(
            """async (episode) => {
                const { Readout } = await import("./readout.js");
                const readout = new Readout(document.querySelector("#readout"));
                readout.show(episode, () => "red");
                readout.at(0);
            }""",
            asdict(episode),
        )
        assert page.evaluate(READ)["rows"] == reading(episode, 0)


@pytest.mark.nightly
@pytest.mark.parametrize("steps", [30, 61])
def test_the_page_shows_what_the_steps_say_to_every_annotator(tmp_path, monkeypatch, steps):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    compare(candidate_dataset(tmp_path / "rollouts", 12, steps=steps), tmp_path, list(LABELERS))
