"""A second rater scores recorded trials blind: shuffled, without policy, code or the first verdict."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.curation.annotation.votes import check_name
from lerobot_roborecover.logs.robot import RobotTrial
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.robot.console import Console
from lerobot_roborecover.robot.run_journal import LOG_FILE, dataset_folder
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.journal import Journal, read_journal
from lerobot_roborecover.utils.text import pluralize

FOLDER = "ratings"
SCHEMA = 1
FRAMES = 40
"""Moments of a trial that are shown in turn."""
_FRAME_S = 0.25


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
        done = {record["episode"] for record in journal.records}
        order = np.random.default_rng([seed, len(rater)]).permutation(len(rows))
        for index in order:
            trial = RobotTrial.of_json(rows[index].robot or {})
            if trial.episode is None or trial.episode in done:
                continue
            video = _Video(console, episodes, trial.episode)
            said = console.ask(
                "rate",
                f"{len(done)} of {len(rows)} rated. Is the task done at the end?",
                ("success", "failure", "pause"),
                {"instruction": rows[index].instruction},
                meanwhile=video.go_on,
            )
            if said.button == "pause":
                break
            journal.append({"episode": trial.episode, "verdict": said.button, "rater": rater})
            done.add(trial.episode)
        console.show("over", "Thank you.")
    say(f"{pluralize(len(done), 'trial')} of {len(rows)} rated by {rater}")
    return len(done)


class _Video:
    """Shows a trial's frames in turn, over and over."""

    def __init__(self, console: Console, episodes: Any, episode: int):
        steps = episodes.steps(episode)
        frames = sorted({round(f) for f in np.linspace(0, steps - 1, min(FRAMES, steps))})
        self._console, self._begun = console, time.monotonic()
        self._pictures = episodes.pictures(episode, frames)
        self._count = len(frames)
        self.go_on()

    def go_on(self) -> None:
        """Shows the frame that is due; the last one stays a while."""
        due = int((time.monotonic() - self._begun) / _FRAME_S) % (self._count + 6)
        shown = min(due, self._count - 1)
        self._console.pictures = {c: (p[shown], p[shown]) for c, p in self._pictures.items()}


def recorded(run: Path) -> list[TrialRow]:
    """The run's trials that a rater can see: with a verdict and a recording.

    Raises:
        ScenarioError: there are none.
    """
    rows = read_trial_log(run / LOG_FILE)
    found = [
        r for r in rows if r.robot is not None and r.robot["episode"] is not None
        and r.robot["verdict"] != "invalid"
    ]  # fmt: skip
    if not found:
        raise ScenarioError(
            f"{run} has no recorded trials with a verdict; is it a run of `roborecover robot run`?"
        )
    return found


def agreement_of(run: Path) -> dict[str, tuple[int, float, float]]:
    """By second rater: trials rated by both, share of equal verdicts, and Cohen's kappa (NaN where one rater
    gave one verdict alone)."""
    first = {r.robot["episode"]: r.robot["verdict"] for r in recorded(run) if r.robot is not None}
    found = {}
    for path in sorted((run / FOLDER).glob("*.jsonl")):
        second = {r["episode"]: r["verdict"] for r in read_journal(path, SCHEMA)}
        both = [(first[e] == "success", v == "success") for e, v in second.items() if e in first]
        if both:
            one, other = np.array(both, bool).T
            found[path.stem] = (len(both), float((one == other).mean()), cohens_kappa(one, other))
    return found


def cohens_kappa(one: np.ndarray, other: np.ndarray) -> float:
    """Cohen's kappa of two raters' yes-or-no verdicts, (N,) bool each; NaN where chance agrees always."""
    agree = float((one == other).mean())
    chance = float(one.mean() * other.mean() + (1 - one.mean()) * (1 - other.mean()))
    return float("nan") if chance >= 1.0 else (agree - chance) / (1 - chance)


def agreement_text(run: Path) -> str:
    """The agreement in words, a line a rater."""
    lines = [
        f"{rater}: {pluralize(count, 'trial')}, {100 * share:.0f} % alike, kappa "
        + ("not defined" if np.isnan(kappa) else f"{kappa:.2f}")
        for rater, (count, share, kappa) in agreement_of(run).items()
    ]
    return "\n".join(lines) or "no second rater has rated this run yet"
