"""The rules that find and name deviations, on traces made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.scenario import DeviationType, Stage

pytestmark = pytest.mark.metaworld

STEPS = 200
START = np.array([0.0, 0.6, 0.02])
GOAL = np.array([0.0, 0.9, 0.02])


def trace(hand, puck, held, *, turn_deg=0.0, other=None, task="push-v3"):
    """A trace from functions of the step; `turn_deg` tips the object over at step 60."""
    from recipes.metaworld.labels import Trace

    made = Trace(task)
    half = np.deg2rad(turn_deg) / 2
    for t in range(STEPS):
        raw = np.zeros(39)
        raw[4:7], raw[36:39] = puck(t), GOAL
        raw[7:11] = (np.sin(half), 0.0, 0.0, np.cos(half)) if t >= 60 else (0.0, 0.0, 0.0, 1.0)
        made.raw.append(raw)
        made.fingertips.append(np.array(hand(t), dtype=float))
        made.held.append(bool(held(t)))
        made.others.append(np.array([] if other is None else [other(t)]).reshape(-1, 3))
    return made


def found(made):
    from recipes.metaworld.labels import recovery_point

    return recovery_point(made)


def by(point, x=0.0, y=0.0, z=0.0):
    """The point moved by some metres."""
    return np.asarray(point) + np.array((x, y, z))


def to(t, end, begin=60, over=20):
    """From `START` to `end` between steps `begin` and `begin + over`."""
    return START + (np.asarray(end) - START) * np.clip((t - begin) / over, 0.0, 1.0)


def arrives(t, end):
    """A hand that comes from above and is at `end` from step 40 on."""
    return by(end, z=0.2 * max(0.0, 1 - t / 40))


BESIDE = by(START, x=0.04)
AWAY = by(START, z=0.25)
HALF_WAY = by(START, y=0.1)
NEARLY = by(GOAL, y=-0.06)
KNOCKED = by(START, x=0.15)


@pytest.mark.parametrize(
    ("made", "stage", "deviation"),
    [
        (lambda: trace(lambda t: arrives(t, BESIDE), lambda t: START, lambda t: False),
         Stage.CONTACT, DeviationType.WRONG_POSE),
        (lambda: trace(lambda t: arrives(t, by(START, x=0.2)), lambda t: START, lambda t: False),
         Stage.APPROACH, DeviationType.WRONG_POSE),
        (lambda: trace(lambda t: to(t, HALF_WAY), lambda t: to(t, HALF_WAY), lambda t: t > 30),
         Stage.MOVE, DeviationType.WRONG_POSE),
        (lambda: trace(lambda t: to(t, NEARLY), lambda t: to(t, NEARLY), lambda t: t > 30),
         Stage.PLACE, DeviationType.WRONG_POSE),
        (lambda: trace(lambda t: to(t, AWAY, 100), lambda t: to(t, HALF_WAY), lambda t: 30 < t < 85),
         Stage.APPROACH, DeviationType.STAGE_ROLLBACK),
        (lambda: trace(lambda t: by(KNOCKED, x=-0.06), lambda t: to(t, KNOCKED), lambda t: False),
         Stage.CONTACT, DeviationType.SCENE_CHANGE),
        (lambda: trace(lambda t: by(START, z=0.07), lambda t: START, lambda t: False, turn_deg=90),
         Stage.CONTACT, DeviationType.SCENE_CHANGE),
        (lambda: trace(lambda t: arrives(t, GOAL), lambda t: START, lambda t: False, task="hammer-v3",
                       other=lambda t: by(GOAL, y=0.03 * (t > 50))),
         Stage.APPROACH, DeviationType.WRONG_TARGET),
    ],
)  # fmt: skip
def test_each_deviation_gets_its_name(made, stage, deviation):
    assert found(made())[1:] == (stage, deviation)


def test_the_point_lies_after_the_event_at_rest_and_before_the_end():
    knocked = trace(lambda t: by(KNOCKED, x=-0.06), lambda t: to(t, KNOCKED), lambda t: False)
    assert 80 <= found(knocked)[0] <= 100


def test_only_the_last_event_counts():
    """Knocked at step 60 and again at 120: the first state was not where the rollout got stuck."""
    far = by(KNOCKED, x=0.1)

    def puck(t):
        return to(t, KNOCKED) if t < 110 else KNOCKED + (far - KNOCKED) * np.clip((t - 120) / 10, 0, 1)

    assert found(trace(lambda t: AWAY, puck, lambda t: False))[0] >= 125


@pytest.mark.parametrize(
    "made",
    [
        # The hand is still on its way, back and forth: nothing stable.
        lambda: trace(lambda t: by(AWAY, x=0.2 * np.sin(t / 8)), lambda t: START, lambda t: False),
        # The object never rests.
        lambda: trace(lambda t: AWAY, lambda t: by(START, x=0.03 * np.sin(t / 5)), lambda t: False),
        # Lost from the grasp but still between the fingers: a picture would not show which.
        lambda: trace(
            lambda t: by(to(t, HALF_WAY), z=0.02), lambda t: to(t, HALF_WAY), lambda t: 30 < t < 85
        ),
    ],
)
def test_no_point_without_a_stable_and_visible_deviation(made):
    assert found(made()) is None
