"""A second rater scores recorded trials blind: shuffled, without policy, code or the first verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.second_rater import FOLDER, SCHEMA, agreement_of, recorded
from lerobot_roborecover.curation.annotation.votes import check_name
from lerobot_roborecover.logs.robot import RobotTrial
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.robot.console import Console
from lerobot_roborecover.robot.run_journal import dataset_folder
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.journal import Journal
from lerobot_roborecover.utils.text import pluralize

FRAMES = 40
"""Moments of a trial that are shown in turn."""
_FRAME_S = 0.25
_END_FRAMES = 12
"""So much longer the last frame stays."""


def rate(run: Path, rater: str, seed: int, host: str, port: int, say: Callable[[str], None]) -> None:
    """Serves the page until every trial is rated.

    Args:
        run: folder of a run.
        rater: who rates.
        seed: of the order.
        host: where the page is served.
        port: 0 takes a free one.
        say: takes lines.

    Raises:
        ScenarioError: the run has no recorded trials, or the name cannot be used.
    """
    from lerobot_roborecover.robot.phone.server import Phone, PhoneConfig

    console = Console()
    phone = Phone(console, PhoneConfig(host, port), say)
    try:
        rate_all(run, rater, seed, console, say)
    finally:
        phone.close()


def rate_all(run: Path, rater: str, seed: int, console: Console, say: Callable[[str], None]) -> int:
    """Shows each trial that this rater has not rated yet; returns how many are rated.

    Args:
        run: folder of a run.
        rater: who rates.
        seed: of the order.
        console: shows and asks.
        say: takes lines.

    Raises:
        ScenarioError: the run has no recorded trials, or the rater gave its first verdicts.
    """
    from lerobot_roborecover.robot.episodes import Episodes

    rows = recorded(run)
    if any(RobotTrial.of_json(r.robot or {}).rater == rater for r in rows):
        raise ScenarioError(
            f"--rater {rater!r:.40} gave this run's first verdicts; a second rater is another"
        )
    episodes = Episodes(dataset_folder(run))
    with Journal(run / FOLDER / f"{check_name(rater)}.jsonl", SCHEMA) as journal:
        done = {record["episode"]: record["verdict"] for record in journal.records}
        order = [rows[i] for i in np.random.default_rng([seed, len(rater)]).permutation(len(rows))]
        left = [row for row in order if _episode(row) not in done]
        given: list[TrialRow] = []
        while left:
            episode = _episode(left[0])
            said = console.ask(
                "rate",
                f"{len(rows) - len(left)} of {len(rows)} rated.{_before(given, done)} "
                "Is the task done at the end?",
                ("success", "failure", *(("undo",) if given else ()), "pause"),
                {"instruction": left[0].instruction},
                meanwhile=Recording(console, episodes, episode),
            )
            if said.button == "pause":
                break
            if said.button == "undo":  # asked again; until it is said anew, what was said stands
                left.insert(0, given.pop())
                continue
            journal.append({"episode": episode, "verdict": said.button, "rater": rater})
            done[episode] = said.button
            given.append(left.pop(0))
        console.show("over", "Thank you.")
    say(f"{pluralize(len(done), 'trial')} of {len(rows)} rated by {rater}")
    return len(done)


def _episode(row: TrialRow) -> int:
    episode = RobotTrial.of_json(row.robot or {}).episode
    assert episode is not None
    return episode


def _before(given: Sequence[TrialRow], done: Mapping[int, str]) -> str:
    """What was said of the trial before, which Undo asks again."""
    return f" The one before: {done[_episode(given[-1])]}." if given else ""


class Recording:
    """Shows a recorded trial's frames in turn, over and over.

    Args:
        console: shows them, and which one it is.
        episodes: the run's dataset.
        episode: of the trial.
    """

    def __init__(self, console: Console, episodes: Any, episode: int):
        steps = episodes.steps(episode)
        frames = sorted({round(f) for f in np.linspace(0, steps - 1, min(FRAMES, steps))})
        self._console, self._begun = console, time.monotonic()
        self._pictures = episodes.pictures(episode, frames)
        self._count = len(frames)

    def __call__(self) -> None:
        """Shows the frame that is due; the last one stays a while."""
        due = int((time.monotonic() - self._begun) / _FRAME_S) % (self._count + _END_FRAMES)
        shown = min(due, self._count - 1)
        self._console.update(moment=shown + 1, moments=self._count)
        self._console.show_live({c: p[shown] for c, p in self._pictures.items()})


def agreement_text(run: Path) -> str:
    """The agreement in words, a line a rater."""
    lines = [
        f"{rater}: {pluralize(count, 'trial')}, {100 * share:.0f} % alike, kappa "
        + ("not defined" if np.isnan(kappa) else f"{kappa:.2f}")
        for rater, (count, share, kappa) in agreement_of(run).items()
    ]
    return "\n".join(lines) or "no second rater has rated this run yet"
