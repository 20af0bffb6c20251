"""A scripted controller for PushT: tries pushes in a copy of the plane, and executes the best."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pymunk

_AGENT = 15.0
"""Radius of the agent, pixels; all lengths here are pixels."""
_LOW, _HIGH = 24.0, 488.0
"""Where the agent may be sent."""
_AROUND = 112.0
"""Radius on which the agent goes around the block: nothing of it reaches so far."""
_CLEAR = 4.0
"""Beside its radius, what a straight way keeps from the block."""
_SPEED, _PUSHING = 38.0, 14.0
"""Of the target, a control step."""
_LENGTHS = (6.0, 16.0, 36.0, 70.0)
"""Of the pushes that are tried."""
_ANGLES = (-0.35, 0.0, 0.35)
"""From the edge's normal, rad."""
_SPACING = 17.0
"""Between the points of an edge at which pushes are tried."""
_TURN = 60.0
"""What a radian of the block's angle costs, beside its distance from the goal in pixels."""
_SUBSTEPS, _DT = 10, 0.01
"""Of gym_pusht's control step."""


class Pusher:
    """Drives the agent of gym_pusht's `PushTEnv`, whose state it reads and never changes.

    Args:
        inner: the environment, reset.
        rng: breaks ties between pushes that help as much, and draws what an imprecise controller gets wrong.
        speed: of its pushes, in those that it plans with; above 1 the block slides further than planned.
        error: standard deviation of where it believes the block to be, pixels.
    """

    def __init__(self, inner: Any, rng: np.random.Generator, *, speed: float = 1.0, error: float = 0.0):
        self._inner, self._speed = inner, speed
        self._offset = rng.normal(0.0, error, 2) if error else np.zeros(2)
        self._model = PlaneCopy(inner)
        self._way: deque[np.ndarray] = deque()

    def __call__(self, t: int) -> np.ndarray:
        """(2,) float64 target of the agent."""
        if not self._way:
            self._way.extend(self._plan())
        return self._way.popleft()

    def _plan(self) -> Iterator[np.ndarray]:
        agent = np.array(self._inner.agent.position)
        block = (np.array(self._inner.block.position) + self._offset, float(self._inner.block.angle))
        start, direction, length = self._best(agent, *block)
        here = agent
        for corner in self._model.way(agent, start, *block):
            yield from _line(here, corner, _SPEED)
            here = corner
        yield here  # comes to rest
        far = here + direction * (length + _CLEAR)
        yield from _line(here, far, _PUSHING * self._speed)
        yield far
        yield here + direction * max(length - 22.0, 0.0)  # lets go

    def _best(
        self, agent: np.ndarray, position: np.ndarray, angle: float
    ) -> tuple[np.ndarray, np.ndarray, float]:
        goal = self._inner.goal_pose
        now = cost(position, angle, goal)
        found, least = None, np.inf
        for point, normal in self._model.points(position, angle):
            start = point - normal * (_AGENT + _CLEAR)
            if not ((start > _LOW) & (start < _HIGH)).all():
                continue
            detour = 0.01 * float(np.linalg.norm(start - agent))
            for turn in _ANGLES:
                c, s = np.cos(turn), np.sin(turn)
                direction = np.array([c * normal[0] - s * normal[1], s * normal[0] + c * normal[1]])
                lengths = [x for x in _LENGTHS if x < 1.6 * now + 6.0]
                outcomes = self._model.push(start, direction, lengths, position, angle)
                for length, (there, turned) in zip(lengths, outcomes, strict=True):
                    if not ((there > 60.0) & (there < 452.0)).all():
                        continue  # against the wall nothing can be pushed back
                    total = cost(there, turned, goal) + detour
                    if total < least:
                        found, least = (start, direction, length), total
        if found is None:
            away = np.array([256.0, 256.0]) - position
            return agent, away / max(float(np.linalg.norm(away)), 1.0), 10.0
        return found


def cost(position: np.ndarray, angle: float, goal: np.ndarray) -> float:
    """How far a block is from where it belongs, pixels.

    Args:
        position: (2,) of the block.
        angle: rad.
        goal: (3,) position and angle.
    """
    turn = (angle - goal[2] + np.pi) % (2 * np.pi) - np.pi
    return float(np.linalg.norm(position - goal[:2]) + _TURN * abs(turn))


class PlaneCopy:
    """A copy of the plane, with an agent and a block to push about."""

    def __init__(self, inner: Any):
        self._inner = inner
        self._space = pymunk.Space()
        self._space.gravity, self._space.damping = (0, 0), inner.space.damping
        self._agent = inner.add_circle(self._space, (256, 400), _AGENT)
        self._block, shapes = inner.add_tee(self._space, (256, 300), 0)
        self._block.center_of_gravity = inner.block.center_of_gravity
        self._edges = _outline(shapes)

    def _put(self, position: np.ndarray, angle: float) -> None:
        block = self._block
        block.angle = angle
        block.position = tuple(position)
        block.velocity, block.angular_velocity = (0, 0), 0.0
        self._space.reindex_shapes_for_body(block)

    def points(self, position: np.ndarray, angle: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Points of the block's outline and the normals into it."""
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s], [s, c]])
        for point, normal in self._edges:
            yield position + turn @ point, turn @ normal

    def push(
        self,
        start: np.ndarray,
        direction: np.ndarray,
        lengths: list[float],
        position: np.ndarray,
        angle: float,
    ) -> list[tuple[np.ndarray, float]]:
        """Where the block would be after pushes along one line, by length, at the planned speed."""
        self._put(position, angle)
        agent, space = self._agent, self._space
        agent.position, agent.velocity = tuple(start), (0, 0)
        space.reindex_shapes_for_body(agent)
        outcomes, gone = [], 0.0
        for length in lengths:
            while gone < length + _CLEAR:
                gone = min(gone + _PUSHING, length + _CLEAR)
                self._drive(start + direction * gone)
            kept = (agent.position, agent.velocity, self._block.velocity, self._block.angular_velocity)
            there, turned = self._block.position, self._block.angle
            self._drive(start + direction * gone)
            outcomes.append((np.array(self._block.position), float(self._block.angle)))
            agent.position, agent.velocity, self._block.velocity, self._block.angular_velocity = kept
            self._block.angle = turned
            self._block.position = there
        return outcomes

    def _drive(self, target: np.ndarray) -> None:
        """One control step, as gym_pusht's."""
        x, y = float(target[0]), float(target[1])
        agent, space = self._agent, self._space
        for _ in range(_SUBSTEPS):
            (px, py), (vx, vy) = agent.position, agent.velocity
            agent.velocity = (
                vx + (100.0 * (x - px) - 20.0 * vx) * _DT,
                vy + (100.0 * (y - py) - 20.0 * vy) * _DT,
            )
            space.step(_DT)

    def way(
        self, here: np.ndarray, there: np.ndarray, position: np.ndarray, angle: float
    ) -> list[np.ndarray]:
        """Corners of a way around the block, its end among them."""
        self._put(position, angle)
        if self._clear(here, there):
            return [there]
        middle = position
        first, last = (np.arctan2(*(p - middle)[::-1]) for p in (here, there))
        ways = []
        for sense in (1.0, -1.0):
            span = (sense * (last - first)) % (2 * np.pi)
            count = max(int(np.ceil(span / 0.4)), 1)
            angles = first + sense * span * np.arange(count + 1) / count
            ring = [middle + _AROUND * np.array([np.cos(a), np.sin(a)]) for a in angles]
            inside = [np.clip(p, _LOW, _HIGH) for p in ring]
            blocked = sum(not self._clear(a, b) for a, b in pairwise(inside))
            ways.append((blocked, span, [*inside, there]))
        corners = min(ways, key=lambda w: w[:2])[2]
        for i in range(len(corners) - 1, 0, -1):  # leaves the ring as soon as it can
            if self._clear(corners[i - 1], there):
                corners[i:] = [there]
        for i in range(len(corners) - 1):  # and enters it as late
            if self._clear(here, corners[i]) and (
                i + 1 == len(corners) or not self._clear(here, corners[i + 1])
            ):
                return corners[i:]
        return corners

    def _clear(self, a: np.ndarray, b: np.ndarray) -> bool:
        rule = pymunk.ShapeFilter()
        hit = self._space.segment_query(tuple(a), tuple(b), _AGENT + _CLEAR - 1.0, rule)
        return not any(found.shape is not None and found.shape.body is self._block for found in hit)


def _line(here: np.ndarray, there: np.ndarray, speed: float) -> Iterator[np.ndarray]:
    count = max(int(np.ceil(float(np.linalg.norm(there - here)) / speed)), 1)
    for i in range(1, count + 1):
        yield here + (there - here) * (i / count)


def _outline(shapes: list[Any]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points on the edges of the block that can be touched, in its own frame, and normals into it."""
    found = []
    for shape in shapes:
        corners = np.array(shape.get_vertices())
        middle = corners.mean(0)
        for a, b in zip(corners, np.roll(corners, -1, 0), strict=True):
            along = b - a
            length = float(np.linalg.norm(along))
            normal = np.array([-along[1], along[0]]) / length
            if normal @ (middle - a) < 0:
                normal = -normal
            count = max(int(length // _SPACING), 1)
            for i in range(count):
                point = a + along * ((i + 0.5) / count)
                outside = point - normal * 3.0
                if all(
                    other is shape or not _within(np.array(other.get_vertices()), outside) for other in shapes
                ):
                    found.append((point, normal))
    return found


def _within(corners: np.ndarray, point: np.ndarray) -> bool:
    edges = np.roll(corners, -1, 0) - corners
    to = point - corners
    side = edges[:, 0] * to[:, 1] - edges[:, 1] * to[:, 0]
    return bool((side >= 0).all() or (side <= 0).all())
