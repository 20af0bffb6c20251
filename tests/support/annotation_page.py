"""What browser tests of the annotation page share."""

from __future__ import annotations

from lerobot_roborecover.curation.annotation.votes import ballot
from lerobot_roborecover.utils.journal import read_journal
from lerobot_roborecover.web.annotate.identity import queue_order
from tests.support.candidate_files import SIDE

EPISODES = 1000


CALLED: dict[str, str] = {}
"""What annotators call an episode, by candidate id; the first episodes of every dataset here are the same."""


def close_guide(page) -> None:
    page.wait_for_selector("#guide[open]")
    press(page, "g")
    page.wait_for_selector("#guide:not([open])", state="attached")


def votes(folder, name: str) -> dict:
    found = ballot(read_journal(folder / "votes" / f"{name}.jsonl", 1), 1).votes
    return {c: (v.verdict, v.step, v.stage, v.deviation, v.reason) for c, v in found.items()}


def press(page, *keys: str) -> None:
    for key in keys:
        page.keyboard.press(key)


def at(page, position: int, name: str) -> str:
    """Waits for the annotator's nth episode and returns its id."""
    candidate = queue_order([f"ep-{i:04d}" for i in range(EPISODES)], name, 0)[position]
    opened(page, candidate)
    return candidate


def opened(page, candidate: str) -> None:
    """Waits for an episode."""
    page.wait_for_selector(f'body[data-episode="{CALLED[candidate]}"]')
    page.wait_for_selector(f'#cameras canvas[data-episode="{CALLED[candidate]}"]')


def shown(page, step: int) -> list[int]:
    """Waits for a frame and reads its number off the pixels, camera by camera."""
    page.wait_for_selector(f'#cameras figure:last-child canvas[data-step="{step}"]')
    return page.evaluate(
        """(side) => [...document.querySelectorAll("#cameras canvas")].map((canvas) => {
          const width = side / 8;
          const row = canvas.getContext("2d").getImageData(0, 16, side, 1).data;
          return Array.from({ length: 8 }, (_, bit) => (row[4 * (bit * width + width / 2)] > 128) << bit)
            .reduce((a, b) => a + b);
        })""",
        SIDE,
    )
