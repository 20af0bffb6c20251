"""A scripted controller for `On` and `In` goals: picks an object up and places it, tries again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_roborecover.platforms.libero.motion import CLOSED, OPEN, ArmMotion, Flaws
from lerobot_roborecover.platforms.libero.scene import Goal, LiberoScene

_HOLLOW = ("bowl", "mug")
"""Objects wider than the gripper, to be grasped by the rim."""
_BESIDE_M = 0.125
"""From the middle of one object to that of another that shares its region."""
_FINGERS = tuple((along_m, -0.01) for along_m in (-0.05, 0.04, 0.055))
_PALM = tuple((float(along_m), 0.09) for along_m in np.linspace(-0.1, 0.1, 9))
"""Where the open hand is, from the grip site: along the axis, and the height from which on up."""


class PickPlace(ArmMotion):
    """Picks and places, one goal after the other, from wherever the simulator is.

    Args:
        scene: of the simulator's current reset.
        goals: which of the scene's goals, in order.
        flaws: errors to make.
    """

    def __init__(self, scene: LiberoScene, goals: Sequence[Goal], flaws: Flaws | None = None):
        super().__init__(scene, flaws)
        self._goals = goals
        self._feet: dict[str, float] = {}
        self._stuck = np.zeros(2)
        """(2,) the side from which another object came along."""
        self._choose()

    def _choose(self) -> None:
        """Takes up the first goal that is not reached, in the middle if its object is already held."""
        pending = [g for g in self._goals if not self._scene.reached(g)]
        self.done = not pending
        pending = pending or list(self._goals[-1:])
        goal = next((g for g in pending if self._scene.holds(g.item)), pending[0])
        self.goal = Goal(goal.predicate, self._flaws.item or goal.item, self._flaws.region or goal.region)
        if self._scene.holds(self.goal.item) and not self._flaws.open_loop:
            self._lift_from = self._item_bottom()
            self._grip_rotation = self._scene.hand_rotation
            self._enter("lift")
        else:
            self._plan()
            self._enter("release" if self._blocked() else "above")

    def _blocked(self) -> bool:
        return any(self._scene.holds(name) for name in self._scene.objects)

    def _item_bottom(self) -> float:
        return float(self._scene.cloud_m(self.goal.item)[:, 2].min())

    # -- grasp --

    def _plan(self) -> None:
        """Where and along which axis the fingers close."""
        cloud = self._scene.cloud_m(self.goal.item)
        low, high = cloud.min(0), cloud.max(0)
        self._top, self._seen_at = float(high[2]), self._scene.position_m(self.goal.item)
        upright = self._scene.upright(self.goal.item) > 0.8
        if upright and any(kind in self.goal.item for kind in _HOLLOW):
            point, axis = self._rim_grasp(cloud)
            height = self._top - 0.018
        else:
            point, axis = self._across_grasp(cloud)
            depth = 0.035 if high[2] - low[2] > 0.07 else 0.022
            height = max(float(low[2]) + 0.012, self._top - depth)
        jitter = self._tries % 3
        turn = self._tries * 2.1
        point = point + 0.004 * jitter * np.array([np.cos(turn), np.sin(turn)])
        self._grasp = np.array([*point, height - 0.004 * jitter]) + self._flaws.aim_m
        flaw = self._flaws.turn_rad
        turned = np.array([[np.cos(flaw), -np.sin(flaw)], [np.sin(flaw), np.cos(flaw)]]) @ axis
        self._grip_rotation = self._down_along(turned)

    def _rim_grasp(self, cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A point on the rim with free space outside, and the axis through it; (2,) and (2,)."""
        ring = cloud[cloud[:, 2] > self._top - 0.012]
        center = (ring.min(0) + ring.max(0))[:2] / 2
        radius = np.percentile(np.linalg.norm(ring[:, :2] - center, axis=1), 70) - 0.004
        obstacles = self._obstacles()
        way = self._way_to_rest()
        grasps: list[tuple[float, np.ndarray, np.ndarray]] = []
        for k in range(24):
            angle = 2 * np.pi * (k + 0.5 * self._tries) / 24
            axis = np.array([np.cos(angle), np.sin(angle)])
            clearance = 0.2
            if len(obstacles):
                clearance = np.linalg.norm(
                    obstacles[:, :2] - (center + (radius + 0.035) * axis), axis=1
                ).min()
            turn = np.arccos(min(1.0, abs(axis @ self._scene.closing_axis)))
            point = center + radius * axis
            score = 20 * min(clearance, 0.05) - 0.5 * turn
            if not self._flaws.open_loop:
                grasp_m = np.array([*point, self._top - 0.018])
                score -= 0.3 * self._in_the_way(grasp_m, axis, _FINGERS + _PALM)
                score -= 0.3 * self._in_the_way(grasp_m + way, axis, _PALM)
            score += self._preference(axis) - max(0.0, axis @ self._stuck)
            grasps.append((score, point, axis))
        _, point, axis = max(grasps, key=lambda grasp: grasp[0])
        return point, axis

    def _preference(self, axis: np.ndarray) -> float:
        """What a side of the rim has for it because of the place that the object goes to."""
        drawer = self._scene.drawer(self.goal.region)
        # A drawer is too narrow for the hand the other way.
        return 0.0 if drawer is None else -abs(float(axis @ drawer.opening[:2]))

    def _way_to_rest(self) -> np.ndarray:
        """(3,) metres from where the object is to where it belongs."""
        way = self._scene.center_m(self.goal.region) - self._scene.position_m(self.goal.item)
        return np.array([*way[:2], max(self._scene.center_m(self.goal.region)[2] - self._item_bottom(), 0.0)])

    def _in_the_way(self, grasp_m: np.ndarray, axis: np.ndarray, hand: Sequence[tuple[float, float]]) -> int:
        """How many sampled points of the open hand would be inside something that is not the object.

        Args:
            grasp_m: (3,) of the grip site.
            axis: (2,) along which the fingers close.
            hand: the parts to look at.
        """
        across = np.array([-axis[1], axis[0]])
        height = grasp_m[2]
        count = 0
        for along_m, rise_m in hand:
            for side_m in (-0.015, 0.015) if rise_m < 0 else (-0.035, 0.0, 0.035):
                xy = grasp_m[:2] + along_m * axis + side_m * across
                ground = self._scene.support_m(np.array([*xy, height + 0.3]), ignore=self.goal.item)
                count += ground > height + rise_m
        return count

    def _across_grasp(self, cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """An object's middle, and of its narrow directions the one nearest to the fingers'; (2,) and (2,)."""
        center = (cloud.min(0) + cloud.max(0))[:2] / 2
        flat = cloud[:, :2] - center
        angles = np.linspace(0, np.pi, 36, endpoint=False)
        axes = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        widths = np.ptp(flat @ axes.T, axis=0)
        narrow = axes[widths < widths.min() + 0.006]
        return center, narrow[np.argmax(np.abs(narrow @ self._scene.closing_axis))]

    def _obstacles(self) -> np.ndarray:
        """(n, 3) points of other objects and of fixtures that stand higher than the object's foot."""
        names = [
            n
            for n in self._scene.env.obj_body_id
            if n != self.goal.item and "table" not in n and n != "floor"
        ]
        clouds = [self._scene.cloud_m(name) for name in names]
        points = np.concatenate(clouds) if clouds else np.zeros((0, 3))
        return points[points[:, 2] > self._item_bottom() + 0.015]

    def _down_along(self, axis: np.ndarray) -> np.ndarray:
        """(3, 3) hand rotation that points down and closes along ±axis, whichever is nearer."""
        now, hand = self._scene.closing_axis, self._scene.hand_rotation
        axis = axis if axis @ now >= 0 else -axis
        yaw = np.arctan2(now[0] * axis[1] - now[1] * axis[0], now @ axis)
        turned = Rotation.from_euler("z", yaw).as_matrix() @ hand
        tilt = np.cross(turned[:, 2], [0.0, 0.0, -1.0])
        sine = np.linalg.norm(tilt)
        if sine > 1e-6:
            angle = np.arctan2(sine, -turned[2, 2])
            turned = Rotation.from_rotvec(tilt / sine * angle).as_matrix() @ turned
        return turned

    # -- motion --

    def _retry(self) -> np.ndarray:
        self._tries += 1
        self._choose()
        return self._up(OPEN, 0.05)

    # -- phases --

    def _moved(self) -> bool:
        return bool(np.linalg.norm(self._scene.position_m(self.goal.item) - self._seen_at) > 0.03)

    def _release(self) -> np.ndarray:
        """Lets go of whatever is in the hand, then backs off."""
        if self._steps > 14:
            self._plan()
            self._enter("above")
        return self._up(OPEN, 0.0 if self._steps < 6 else 0.06)

    def _above(self) -> np.ndarray:
        hand = self._scene.hand_m
        off = np.linalg.norm(self._grasp[:2] - hand[:2])
        if not self._flaws.open_loop and self._moved():
            self._plan()
        hover = self._top + 0.09
        if not self._flaws.open_loop:
            hover = min(hover, max(self._top + 0.035, self._scene.reach_up_m(self._grasp[:2])))
        if hand[2] < self._top + 0.06 and off > 0.03:  # up before sideways
            return self._toward(np.array([*hand[:2], self._top + 0.12]), OPEN)
        near = 0.025 if self._flaws.open_loop else 0.006
        arrived = off < near and abs(hand[2] - hover) < 0.03 and np.linalg.norm(self._rotation_error()) < 0.1
        if arrived or self._steps > 90:
            if not self._flaws.open_loop:
                self._plan()
            self._enter("down")
        height = hover if off < 0.06 else max(self._top + 0.12, min(hand[2], self._top + 0.2))
        return self._toward(np.array([*self._grasp[:2], height]), OPEN)

    def _down(self) -> np.ndarray:
        hand = self._scene.hand_m
        if hand[2] - self._grasp[2] < 0.006 or self._steps > 30:
            self._hold = np.array([*hand[:2], min(hand[2], self._grasp[2] + 0.004)])
            self._enter("close")
        height = self._grasp[2] if np.linalg.norm(self._grasp[:2] - hand[:2]) < 0.012 else hand[2]
        if self._flaws.open_loop:
            height = self._grasp[2]
        return self._toward(np.array([*self._grasp[:2], height]), OPEN)

    def _close(self) -> np.ndarray:
        if self._steps > 10:
            self._lift_from = self._item_bottom()
            self._feet = {name: float(self._scene.position_m(name)[2]) for name in self._scene.objects}
            self._enter("lift")
        return self._toward(self._hold, CLOSED, turn=False)

    def _lift(self) -> np.ndarray:
        hand = self._scene.hand_m
        clear = self._clear() + 0.01 + self._flaws.carry_m
        if self._flaws.open_loop:
            if hand[2] > clear + 0.08 or self._steps > 40:
                self._enter("carry")
            return self._up(CLOSED, 0.08)
        bottom = self._item_bottom()
        if self._steps > 12 and not self._scene.holds(self.goal.item) and bottom - self._lift_from < 0.02:
            return self._retry()
        if self._steps < 20 and self._lifts_another():
            self._stuck = self._grasp[:2] - self._scene.position_m(self.goal.item)[:2]
            self._stuck /= max(np.linalg.norm(self._stuck), 1e-6)
            self._retry()
            self._enter("release")
            return self._up(OPEN, 0.0)
        if bottom > clear - 0.01:
            if self._shares():
                self._grip_rotation = self._down_along(np.array([0.0, 1.0]))
            self._enter("carry")
        elif self._steps > 60:
            return self._retry()
        return self._up(CLOSED, float(np.clip(clear - bottom, 0.05, 0.08)))

    def _clear(self) -> float:
        """Height, metres, at which the object's foot meets nothing on the way that is left."""
        rim = self._scene.rim_m(self.goal.region) + 0.04
        if self._flaws.open_loop:
            return rim
        start = self._scene.position_m(self.goal.item)
        way = self._goal_xy() - start[:2]
        across = 0.05 * np.array([-way[1], way[0]]) / max(np.linalg.norm(way), 1e-6)
        above = self._item_bottom() + 0.3
        points = [
            start[:2] + t * way + side * across for t in np.linspace(0, 0.9, 10) for side in (-1.0, 0.0, 1.0)
        ]
        tops = [self._scene.support_m(np.array([*p, above]), ignore=self.goal.item) for p in points]
        return max(rim, max(tops) + 0.02)

    def _lifts_another(self) -> bool:
        """Whether another object, wedged under this one, has come along."""
        here = self._scene.position_m(self.goal.item)
        for name in self._scene.objects:
            there = self._scene.position_m(name)
            under = name != self.goal.item and np.linalg.norm((there - here)[:2]) < 0.05
            if under and there[2] > self._feet.get(name, np.inf) + 0.012:
                return True
        return False

    def _goal_xy(self) -> np.ndarray:
        return self._scene.center_m(self.goal.region)[:2] + self._slot() + self._flaws.place_m

    def _shares(self) -> bool:
        """Whether several objects are to stand beside one another in the region."""
        goals = [g for g in self._goals if g.predicate[0] == "on" and g.region == self.goal.region]
        return len(goals) > 1 and not self._flaws.open_loop

    def _slot(self) -> np.ndarray:
        """(2,) metres from a region's middle to the object's own place in it: objects stand along x, fingers
        close along y."""
        if not self._shares():
            return np.zeros(2)
        middle = self._scene.center_m(self.goal.region)[:2]
        others = [g.item for g in self._goals if g.region == self.goal.region and g.item != self.goal.item]
        off = [self._scene.position_m(name)[:2] - middle for name in others]
        there = [float(xy[0]) for xy in off if np.linalg.norm(xy) < 0.12]
        if not there:
            return np.array([-_BESIDE_M / 2, 0.0])
        side = -1.0 if there[0] > 0 else 1.0
        return np.array([float(np.clip(there[0] + side * _BESIDE_M, -0.068, 0.068)), 0.0])

    def _carried_xy(self) -> np.ndarray:
        """Returns where the object is; open loop, where the hand is."""
        if self._flaws.open_loop:
            return self._scene.hand_m[:2]
        return self._scene.position_m(self.goal.item)[:2]

    def _lost(self) -> bool:
        return not self._flaws.open_loop and not self._scene.holds(self.goal.item)

    def _carry(self) -> np.ndarray:
        if self._flaws.drop_after and self._steps > self._flaws.drop_after:
            self._enter("open")
        if self._lost():
            return self._retry()
        hand = self._scene.hand_m
        way = self._goal_xy() - self._carried_xy()
        turned = not self._shares() or np.linalg.norm(self._rotation_error()) < 0.15
        if (np.linalg.norm(way) < 0.010 and turned) or self._steps > 90:
            self._enter("lower")
        rise = self._clear() - self._item_bottom()
        if self._flaws.open_loop:
            rise = self._scene.rim_m(self.goal.region) + 0.12 + self._flaws.carry_m - hand[2]
        return self._toward(np.array([*(hand[:2] + way), hand[2] + rise]), CLOSED, gain=1.2)

    def _lower(self) -> np.ndarray:
        if self._lost():
            return self._retry()
        hand, bottom = self._scene.hand_m, self._item_bottom()
        if "contain_region" in self.goal.region and "basket" in self.goal.region:
            rest = self._scene.rim_m(self.goal.region) - 0.02
        else:
            under = np.array([*self._carried_xy(), bottom + 0.01])
            rest = self._scene.support_m(under, ignore=self.goal.item) + 0.006
        if bottom - rest < 0.006 or self._steps > 30:
            self._enter("open")
        way = self._goal_xy() - self._carried_xy()
        drop = max(rest - bottom, -0.08)
        if self._flaws.open_loop:
            drop = self._scene.rim_m(self.goal.region) + 0.05 - hand[2]
        return self._toward(np.array([*(hand[:2] + way), hand[2] + drop]), CLOSED, gain=0.9)

    def _open(self) -> np.ndarray:
        if self._steps > 6:
            self._enter("retreat")
        return self._toward(self._scene.hand_m, OPEN, turn=False)

    def _retreat(self) -> np.ndarray:
        if self._steps > 20:
            if self._flaws.open_loop:
                self._enter("rest")
            else:
                self._tries += 1
                self._choose()
        return self._up(OPEN, 0.06)
