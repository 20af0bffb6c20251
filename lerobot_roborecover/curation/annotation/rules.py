"""From what the page shows to a verdict: the rules of the automatic annotators, after the page's own guide.

docs/log/automatic_labels.md, lists them. They see the numbers of the readout at the frames that were
looked at, the instruction's object (the one with a goal) and the line above the frames; not the simulator.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.curation.annotation.annotators import LabelerThresholds
from lerobot_roborecover.curation.annotation.features import HAND, EpisodeFeatures
from lerobot_roborecover.scenario import DeviationType, Stage

FALLEN_M = 0.3
"""An object this far below where it began is off the table, not only off what stands on it."""
THROWN_M = 0.8
"""An object this far from where it began is out of the workspace."""
OTHER_MOVED_M, OTHER_REACHED_M = 0.01, 0.06
"""A part that is not to be handled was touched where it has moved this far and the hand is this near."""
PUT_DOWN_HEIGHT_M, PUT_DOWN_M_S = 0.03, 0.15
"""An object was put down, not dropped, where the gripper was opened this low and this slowly."""
CARRY_STEP_M, CARRY_REACH_M, CARRY_GAP_S, CARRY_S = 0.004, 0.008, 0.2, 0.15
"""From one look to the next, at most so much later: an object goes with the hand that moves by the first
while its distance from the hand changes by less than the second, and that for at least so long..."""
HELD_REACH_M = 0.015
"""... and stays in the grasp while that distance stays within this."""
PAUSE_M_S, PAUSE_S = 0.04, 0.3
"""A person who stops has the hand slower than this for at least this long."""


@dataclass(frozen=True)
class Verdict:
    """The entry that the rules propose."""

    step: int | None = None
    stage: Stage | None = None
    deviation: DeviationType | None = None
    discard: str = ""
    """Reason; empty where the trajectory is kept."""


def judge(look: EpisodeFeatures, eye: LabelerThresholds) -> Verdict:
    """The verdict on an episode.

    Args:
        look: looked at all along the episode, more closely wherever the point may be.
        eye: whose.
    """
    if look.sheet.solved and not look.sheet.human:
        return Verdict(discard="temporary")
    seen = _Seen(look, eye)
    if seen.fallen():
        return Verdict(discard="irreversible")
    if seen.thrown():
        return Verdict(discard="erratic")
    found = seen.human_point() if look.sheet.human else seen.final_point()
    if found is not None:
        return Verdict(int(seen.frames[found[0]]), *found[1])
    if look.sheet.human:
        return Verdict(discard="unclear")
    # A deviation that was there for a while and was overcome, or none at all.
    return Verdict(discard="temporary" if seen.any_point() else "unclear")


class _Seen:
    """Measurements of a look: arrays of n, one value a frame looked at."""

    def __init__(self, look: EpisodeFeatures, eye: LabelerThresholds):
        self.eye, self.frames, self.seconds = eye, look.frames(), look.seconds()
        self.n = len(self.frames)
        names = look.objects()
        self._reach = {name: _need(look.values(name, "reach")) for name in names}
        self._moved = {name: _need(look.values(name, "moved")) for name in names}
        self._height = {name: _need(look.values(name, "height")) for name in names}
        self.hand_m_s = _need(look.values(HAND, "speed"))
        self.main = self._handled(look, names)
        self.others = [name for name in names if name != self.main]
        goal = look.values(self.main, "goal")
        self.goal = np.full(self.n, np.inf) if goal is None else goal
        self._has_goal = goal is not None
        self.closed = look.closed()
        self.pushes = self._has_goal and not look.grips()
        """Nothing can be held: what has a place is pushed there."""
        self.held, self.carried = self._grasps()
        self._released = self._releases()
        self.labels = [self._label(i) for i in range(self.n)]

    def _handled(self, look: EpisodeFeatures, names: list[str]) -> str:
        """The object with a goal; of several, the one that the hand is nearest to in the end (where a person
        stopped, of a human-made rollout) among those that are not at their place yet; where none has one, the
        one that ends farthest from where it began."""
        goals = {name: away for name in names if (away := look.values(name, "goal")) is not None}
        if not goals:
            return max(names, key=lambda name: self._moved[name][-1])
        first, after = self._pause() if look.sheet.human else (self.n - 1, self.n)
        at = max((first + after) // 2, 0)
        pending = [name for name, away in goals.items() if away[at] >= self.eye.place_m] or list(goals)
        return min(pending, key=lambda name: self._reach[name][at])

    def fallen(self) -> bool:
        """The object fell off the table."""
        return bool(self._height[self.main].min() < -FALLEN_M)

    def thrown(self) -> bool:
        """The object left the workspace."""
        return bool(self._moved[self.main].max() > THROWN_M)

    def final_point(self) -> tuple[int, tuple[Stage, DeviationType]] | None:
        """Where the last deviation begins: the first look of the last run of equal labels that is long
        enough, where nothing but shorter ones follows, and no progress."""
        for run in reversed(self._runs([self._final(i) for i in range(self.n)])):
            if self.seconds[run[-1]] - self.seconds[run[0]] >= self.eye.stable_s:
                label = self.labels[run[0]]
                assert label is not None
                return run[0], label
        return None

    def any_point(self) -> bool:
        """Whether anything went wrong for a while."""
        runs = self._runs([True] * self.n)
        return any(self.seconds[run[-1]] - self.seconds[run[0]] >= self.eye.stable_s for run in runs)

    def _runs(self, wanted: list[bool]) -> list[list[int]]:
        """Looks with the same label one after the other; looks without one do not interrupt."""
        runs: list[list[int]] = []
        for i in range(self.n):
            if self.labels[i] is None or not wanted[i]:
                continue
            if not runs or self.labels[runs[-1][-1]] != self.labels[i]:
                runs.append([])
            runs[-1].append(i)
        return runs

    def human_point(self) -> tuple[int, tuple[Stage, DeviationType]] | None:
        """Where the person stopped for longest, before putting it right."""
        for i in range(*self._pause()):
            label = self.labels[i]
            if label is not None:
                return i, label
        return None

    def _pause(self) -> tuple[int, int]:
        """First look of the hand's longest pause, and the one after its last; (-1, -1): there is none."""
        longest, began = (0.0, -1, -1), None
        for i in range(self.n + 1):
            slow = i < self.n and self.hand_m_s[i] < PAUSE_M_S
            if slow and began is None:
                began = i
            elif not slow and began is not None:
                longest = max(longest, (self.seconds[i - 1] - self.seconds[began], began, i))
                began = None
        lasted, first, after = longest
        return (-1, -1) if lasted < PAUSE_S else (first, after)

    def _grasps(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) bool: the object is in the grasp; it has been carried within one grasp before or now."""
        held, carried = np.zeros(self.n, bool), np.zeros(self.n, bool)
        reach, grasp_reach, far, lasted = self._reach[self.main], None, 0.0, 0.0
        for i in range(1, self.n):
            by = self._travel(self.main, i - 1, i)
            along = by > CARRY_STEP_M and abs(reach[i] - reach[i - 1]) < CARRY_REACH_M
            near = reach[i] < self.eye.contact_m
            gap = self.seconds[i] - self.seconds[i - 1]
            if along and near and gap < CARRY_GAP_S:
                grasp_reach, far, lasted = reach[i], far + by, lasted + gap
            elif (
                grasp_reach is None
                or abs(reach[i] - grasp_reach) > HELD_REACH_M
                or not self.closed[i]
                or lasted < CARRY_S
            ):
                grasp_reach, far, lasted = None, 0.0, 0.0
            held[i] = lasted >= CARRY_S
            carried[i] = carried[i - 1] or (held[i] and far > self.eye.carried_m)
        return held, carried

    def _releases(self) -> np.ndarray:
        """(n,) bool: the latest grasp ended with the object put down: gripper opened, low and slow."""
        put = np.zeros(self.n, bool)
        for i in range(1, self.n):
            put[i] = put[i - 1] and not self.held[i]
            if self.held[i - 1] and not self.held[i]:
                low = self._height[self.main][i] < PUT_DOWN_HEIGHT_M
                gap = max(self.seconds[i] - self.seconds[i - 1], 1e-9)
                slow = self._travel(self.main, i - 1, i) / gap < PUT_DOWN_M_S
                put[i] = bool(low and slow and not self.closed[i])
        return put

    def _label(self, i: int) -> tuple[Stage, DeviationType] | None:
        """Stage and type of a deviation at a look, or None where there is none (yet)."""
        eye, reach = self.eye, self._reach[self.main][i]
        placed = self.goal[i] < eye.place_m
        hand = Stage.CONTACT if reach <= eye.contact_m else Stage.APPROACH
        if self.pushes:
            return self._pushed(i, Stage.PLACE if placed else hand)
        if self.held[i]:
            if any(self._moved[name][i] > eye.knocked_m for name in self.others) and self._rests(i):
                return Stage.PLACE, DeviationType.SCENE_CHANGE
            stage = Stage.PLACE if placed else Stage.MOVE
            return (stage, DeviationType.WRONG_POSE) if self._stalled(i) or self._stuck(i) else None
        if not self._rests(i):
            return None
        if self._at_other(i) and not self.carried[i]:
            return hand, DeviationType.WRONG_TARGET
        if self.carried[i] and self._released[i] and not placed and self._has_goal and reach < eye.contact_m:
            return Stage.PLACE, DeviationType.WRONG_TARGET
        if self.carried[i] and reach >= eye.lost_m:
            if placed:
                return Stage.PLACE, DeviationType.SCENE_CHANGE
            return hand, DeviationType.STAGE_ROLLBACK
        if not self.carried[i] and self._sideways(i) > eye.knocked_m:
            return hand, DeviationType.SCENE_CHANGE
        return (hand, DeviationType.WRONG_POSE) if self._stalled(i) or self._stuck(i) else None

    def _pushed(self, i: int, stage: Stage) -> tuple[Stage, DeviationType] | None:
        """Of what is pushed to its place: it lies still farther from there than it was, or nothing comes of
        it any more. That it moves sideways, and is left, is the task."""
        if not self._rests(i):
            return None
        if self.goal[i] - self.goal[: i + 1].min() > self.eye.event_m:
            return stage, DeviationType.STAGE_ROLLBACK
        return (stage, DeviationType.WRONG_POSE) if self._stalled(i) or self._stuck(i) else None

    def _at_other(self, i: int) -> bool:
        """The hand is at a part that is not to be handled, and has moved it."""
        return any(
            self._moved[name][i] > OTHER_MOVED_M
            and self._reach[name][i] < OTHER_REACHED_M
            and self._reach[name][i] < self._reach[self.main][i]
            for name in self.others
        )

    def _rests(self, i: int) -> bool:
        window = (self.seconds <= self.seconds[i]) & (
            self.seconds >= self.seconds[i] - self.eye.rest_s - 1e-9
        )
        if self.seconds[i] - self.seconds[0] < self.eye.rest_s or window.sum() < 2:
            return False
        return self._span(self.main, window) < self.eye.rest_m

    def _stuck(self, i: int) -> bool:
        before, after = self.seconds[i] - self.eye.stuck_s, self.seconds[i] + self.eye.stuck_s
        if before < self.seconds[0] or after > self.seconds[-1] + 1e-9:
            return False
        window = (self.seconds >= before - 1e-9) & (self.seconds <= after + 1e-9)
        spans = [np.ptp(reach[window]) for reach in self._reach.values()]
        return bool(max(spans) < self.eye.stuck_m and self._span(self.main, window) < self.eye.stuck_m)

    def _stalled(self, i: int) -> bool:
        """Whether there is no progress any more, up to the end: the object does not come nearer to its goal,
        nor, where it is not in the grasp, the hand to the object."""
        reach, some = self._reach[self.main], self.eye.event_m / 2
        if not self._has_goal or self._progress_follows(i):
            return False
        return bool(self.held[i] or reach[i] - reach[i:].min() < some)

    def _final(self, i: int) -> bool:
        """Whether a look's label is not overcome later."""
        label = self.labels[i]
        if label is None or self._progress_follows(i):
            return False
        return label[1] is not DeviationType.WRONG_POSE or not self._has_goal or self._stalled(i)

    def _progress_follows(self, i: int) -> bool:
        """Whether the object comes nearer to its goal later; where that is not known, whether it moves."""
        if self._has_goal:
            return bool(self.goal[i] - self.goal[i:].min() > self.eye.event_m / 2)
        away = max(
            np.abs(values[name][i:] - values[name][i]).max()
            for values in (self._moved, self._height)
            for name in (self.main, *self.others)
        )
        return bool(away > self.eye.event_m)

    def _travel(self, name: str, i: int, j: int) -> float:
        """How far an object has gone from one look to another, as far as the numbers tell."""
        steps = [abs(v[name][j] - v[name][i]) for v in (self._moved, self._height)]
        if name == self.main and self._has_goal:
            steps.append(abs(self.goal[j] - self.goal[i]))
        return float(max(steps))

    def _span(self, name: str, window: np.ndarray) -> float:
        spans = [np.ptp(v[name][window]) for v in (self._moved, self._height)]
        if name == self.main and self._has_goal:
            spans.append(np.ptp(self.goal[window]))
        return float(max(spans))

    def _sideways(self, i: int) -> float:
        """How far the object is from where it began, seen from above."""
        moved, height = self._moved[self.main][i], self._height[self.main][i]
        return float(np.sqrt(max(moved**2 - height**2, 0.0)))


def _need(values: np.ndarray | None) -> np.ndarray:
    if values is None:
        raise ValueError("no place of an object is shown")
    return values
