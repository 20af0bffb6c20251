"""The scenario gallery: what each scenario looks like and how every policy did on it."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.pages.trial_details import ShownTrial, packed_within
from lerobot_roborecover.analysis.robot_tables import outcome_words
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.scenario import Outcome, Scenario

SIGNS = {"success": "●", "failure": "○", "invalid": "!"}
"""Distinguished by shape, not by colour."""
OUTCOME_CLASSES = {
    "split": "some policies solve it",
    "none": "no policy solves it",
    "all": "every policy solves it",
    "invalid": "has invalid trials",
}
"""What the gallery's outcome filter offers; a scenario may be in several."""


@dataclass(frozen=True)
class PolicyMarks:
    policy: str
    signs: str
    """One sign a trial, in their order."""
    words: str
    """The same for readers without the signs."""
    initial: str = ""
    """Signs of the trials from the initial state; empty where there are none."""
    rate: float | None = None
    """Share of its trials that solved it, in [0, 1]; None where it was not run."""


@dataclass(frozen=True)
class TrialVideo:
    """A video of one trial, or a recording for the rerun viewer."""

    policy: str
    uri: str
    """Data URI, or the file's path from the page."""
    trial: int = 0
    """Number of the trial, from 0."""
    outcome: str = ""
    """How the trial ended, by its log row; empty where no row of it is known."""

    @property
    def words(self) -> str:
        """Which trial it shows, and how that ended."""
        kind = "solved" if self.outcome == Outcome.SUCCESS else "not solved" if self.outcome else ""
        return ", ".join(filter(None, (f"trial {self.trial + 1}", kind)))

    @property
    def recording(self) -> bool:
        """Whether the rerun viewer shows it, and not the browser."""
        return self.uri.endswith(".rrd")


@dataclass(frozen=True)
class Card:
    id: str
    instruction: str
    task: str
    suite: str
    cell: str
    source: str
    source_policy: str
    frame: str
    """Data URI of the recovery frame, or its file's path from the page; empty where there is none."""
    marks: tuple[PolicyMarks, ...]
    clips: tuple[TrialVideo, ...]
    outcome_classes: tuple[str, ...]
    disagreement: float
    """Standard deviation of the policies' rates, in [0, 0.5]."""
    rate: float
    """Mean of the policies' rates."""
    trials: str = ""
    """Its trials, see `trial_details.packed`; empty where the page has no room for them."""


def make_cards(
    panel: Panel,
    frames: Mapping[str, bytes | str],
    clips: Mapping[str, Sequence[TrialVideo]],
    initial: Panel | None = None,
    interventions: Panel | None = None,
    action_folders: Sequence[Path] = (),
) -> list[Card]:
    """Cards of all scenarios, those on which policies disagree most first.

    Args:
        panel: trials from recovery points.
        frames: PNG or JPEG files by scenario id: their content, or their path from the page.
        clips: videos by scenario id.
        initial: trials of the same policies from initial states.
        interventions: trials of arms that are no policies; those that are in `panel`, too, are shown once.
        action_folders: where actions of the trials were recorded.
    """
    before = _initial_rows(initial)
    acting = _acting(panel, interventions)
    cards: list[Card] = []
    trials: dict[str, list[ShownTrial]] = {}
    for n, scenario in enumerate(panel.scenarios):
        rates = panel.rates[:, n]
        run = rates[np.isfinite(rates)]
        shown: dict[str, tuple[Sequence[TrialRow], int]] = {
            arm: (panel.rows.get((p, n), ()), int(panel.trials[p, n])) for p, arm in enumerate(panel.arms)
        }
        shown |= {arm: of[scenario.id] for arm, of in acting.items() if scenario.id in of}
        trials[scenario.id] = [
            ShownTrial(arm, start, k, row)
            for arm, (rows, _) in shown.items()
            for start, own in (("recovery", rows), ("initial", before.get((arm, scenario.id), ())))
            for k, row in enumerate(own)
        ]
        cards.append(
            Card(
                id=scenario.id,
                instruction=scenario.instruction,
                task=scenario.task,
                suite=scenario.suite,
                cell=scenario.cell.replace("-", ", ", 1),
                source=scenario.source,
                source_policy=scenario.source_policy,
                frame=_image_uri(frames.get(scenario.id, "")),
                marks=tuple(
                    _marks(arm, rows, scheduled, before.get((arm, scenario.id), ()))
                    for arm, (rows, scheduled) in shown.items()
                ),
                clips=tuple(
                    _with_outcome(clip, shown.get(clip.policy, ((), 0))[0])
                    for clip in clips.get(scenario.id, ())
                ),
                outcome_classes=_classes(run, bool(panel.invalid[:, n].any())),
                disagreement=float(run.std()),
                rate=float(run.mean()),
            )
        )
    cards.sort(key=lambda card: (-card.disagreement, card.id))
    texts = packed_within([trials[card.id] for card in cards], action_folders)
    return [replace(card, trials=text) for card, text in zip(cards, texts, strict=True)]


def _acting(
    panel: Panel, interventions: Panel | None
) -> dict[str, dict[str, tuple[Sequence[TrialRow], int]]]:
    """Rows of every arm that is no policy, and how many there should be, by scenario id."""
    if interventions is None:
        return {}
    return {
        arm: {
            scenario.id: (interventions.rows.get((p, n), ()), int(interventions.trials[p, n]))
            for n, scenario in enumerate(interventions.scenarios)
            if interventions.trials[p, n]
        }
        for p, arm in enumerate(interventions.arms)
        if arm not in panel.arms
    }


def _with_outcome(clip: TrialVideo, rows: Sequence[TrialRow]) -> TrialVideo:
    return replace(clip, outcome=next((row.outcome for row in rows if row.trial == clip.trial), ""))


@dataclass(frozen=True)
class PairedVideo:
    """One or two videos from one recovery point."""

    card: Card
    clips: tuple[TrialVideo, ...]


def choose_pair(cards: Sequence[Card]) -> PairedVideo | None:
    """Two videos of one scenario for the first screen: of two policies, or of two trials.

    Preferred are two that ended differently, then two policies, then the order of the cards.

    Args:
        cards: of `make_cards`.

    Returns:
        Two videos; one where no scenario has two; None without any.
    """
    found: list[tuple[tuple[int, bool, bool], PairedVideo]] = []
    for card in cards:
        shown = [clip for clip in card.clips if not clip.recording]
        for pair in [*combinations(shown, 2), *((clip,) for clip in shown[:1])]:
            ends, names = {c.outcome == Outcome.SUCCESS for c in pair}, {c.policy for c in pair}
            score = (len(pair), len(ends) > 1 and all(c.outcome for c in pair), len(names) > 1)
            found.append((score, PairedVideo(card, pair)))
    return max(found, key=lambda item: item[0])[1] if found else None


def _classes(rates: np.ndarray, invalid: bool) -> tuple[str, ...]:
    solved = rates > 0
    kind = "all" if solved.all() else "split" if solved.any() else "none"
    return (kind, "invalid") if invalid else (kind,)


def _initial_rows(panel: Panel | None) -> Mapping[tuple[str, str], Sequence[TrialRow]]:
    """Rows from initial states by policy and scenario id."""
    if panel is None:
        return {}
    found: dict[tuple[str, str], list[TrialRow]] = {}
    for (p, _), rows in panel.rows.items():
        for row in rows:
            found.setdefault((panel.arms[p], row.scenario_id), []).append(row)
    return found


_VALID = frozenset(outcome.value for outcome in Outcome if outcome.valid)


def _kinds(rows: Sequence[TrialRow]) -> list[str]:
    return ["success" if r.success else "failure" if r.outcome in _VALID else "invalid" for r in rows]


def _marks(policy: str, rows: Sequence[TrialRow], scheduled: int, initial: Sequence[TrialRow]) -> PolicyMarks:
    before = _kinds(initial)
    from_start = f"; from the initial state {before.count('success')} of {len(before)}" if before else ""
    signs = "".join(SIGNS[kind] for kind in before)
    if not scheduled:
        return PolicyMarks(policy, "", f"not run{from_start}", signs)
    kinds = _kinds(rows)
    missing = scheduled - len(rows)
    words = f"solved {kinds.count('success')} of {scheduled} trials"
    if missing:
        words += f", {missing} without a row"
    for row in rows:
        if row.outcome not in _VALID:
            why = f", {row.reason}" if row.reason else ""
            words += f"; trial {row.trial}: {outcome_words(Outcome(row.outcome), row.robot is not None)}{why}"
    shown = "".join(SIGNS[kind] for kind in kinds) + "–" * missing
    return PolicyMarks(policy, shown, words + from_start, signs, kinds.count("success") / scheduled)


def _image_uri(data: bytes | str) -> str:
    if isinstance(data, str):
        return data
    kind = "png" if data.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def gallery_values(cards: Sequence[Card], robots: bool = False) -> dict[str, Any]:
    """What the gallery's template asks for.

    Args:
        cards: of `make_cards`.
        robots: their trials are of robots.
    """
    present = {kind for card in cards for kind in card.outcome_classes}
    policies = list(dict.fromkeys(mark.policy for card in cards for mark in card.marks))
    return {
        "cards": cards,
        "both_starts": any(mark.initial for card in cards for mark in card.marks),
        "choices": {
            key: sorted({getattr(card, key) for card in cards}) for key in ("cell", "source", "suite")
        },
        "outcome_classes": {k: v for k, v in OUTCOME_CLASSES.items() if k in present},
        "signs": SIGNS,
        "robots": robots,
        "untold": sum(not card.trials for card in cards),
        "policies": policies,
    }


def check_scenarios(trials: Iterable[TrialRow], scenarios: Sequence[Scenario], name: str) -> list[str]:
    """Compares trials with the scenario set they are said to be on.

    Args:
        trials: from the logs.
        scenarios: the set.
        name: what to call it.

    Returns:
        Remarks: scenarios without any trial, of the splits that have trials.

    Raises:
        RowsError: a row's scenario is not in the set, or is another one of the same name.
    """
    known = {s.id: s.sha256() for s in scenarios}
    rows = {row.scenario_id: row for row in trials}
    unknown = sorted(set(rows) - set(known))
    if unknown:
        raise RowsError(
            f"the logs have trials on {len(unknown)} scenario(s) that {name} lacks, e.g. "
            f"{unknown[0]} (from dataset "
            f"{rows[unknown[0]].dataset}). Name the set that was evaluated, or leave --scenarios out"
        )
    changed = sorted(i for i, row in rows.items() if row.scenario_sha256 != known[i])
    if changed:
        raise RowsError(
            f"{len(changed)} scenario(s) differ between the logs and {name}, e.g. {changed[0]}: the "
            "set was changed "
            "after the evaluation. Name the revision that was evaluated"
        )
    splits = {row.split for row in rows.values()}
    whole = {s.id for s in scenarios if s.labels.split in splits}  # a study of one split lacks no other
    idle = sorted(whole - set(rows))
    return [f"{len(idle)} of {len(whole)} scenarios of {name} have no trial, e.g. {idle[0]}"] if idle else []
