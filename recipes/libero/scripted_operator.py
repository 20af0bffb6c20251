"""A scripted operator at the real teleoperation interface of LIBERO: makes a deviation, stops, marks it, and
completes the task all the same.

    python -m recipes.libero.scripted_operator --out OUT --init-states 16-19

Starts the server of `curate teleop` and talks to it over its websocket, as the page does. The websocket does
not carry what the scripted expert has to know of the scene. So the operator steps a simulator of its own with
the same actions, and its state must equal the server's exactly. It replaces a person where none is available;
its recordings name it as controller.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lerobot_roborecover.platforms.libero.catalog import LIBERO_HORIZONS, PLACE_KINDS, libero_goal
from lerobot_roborecover.platforms.libero.expert import LiberoExpert
from lerobot_roborecover.platforms.libero.platform import PLATFORM
from lerobot_roborecover.platforms.libero.scene import LiberoScene
from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator
from lerobot_roborecover.platforms.simulator import advance
from lerobot_roborecover.platforms.starts import parse_numbers
from lerobot_roborecover.scenario import Pose, ScenarioError, Task
from lerobot_roborecover.web.teleop.client import Client
from lerobot_roborecover.web.teleop.serve import TeleopConfig
from lerobot_roborecover.web.teleop.starts import StartPoint, first_state
from recipes.deviations import DEVIATIONS, Deviation, Fumbled, Hand
from recipes.scripted_operator import FRAME_STRIDE, OPERATOR, Stop, Turn, drive
from recipes.scripted_operator import record as record_turns

STOP = Stop(30, 10)
_CLEAR_M = 0.035


class Mirror:
    """A simulator that does what the server's does.

    Args:
        simulator: the operator's own.
        client: at the server.
    """

    def __init__(self, simulator: LiberoSimulator, client: Client):
        self.simulator, self._client = simulator, client

    def start(self, start: StartPoint, number: int) -> LiberoScene:
        """Puts both in a start; the scene there."""
        self._client.start(number, discard=True)
        self.simulator.reset(start.task, start.reset)
        advance(self.simulator, start.prefix)
        self._check()
        return LiberoScene(self.simulator)

    def act(self, action: np.ndarray) -> bool:
        """One (7,) action; whether the task is solved."""
        solved = bool(self._client.act(action)["solved"])
        self.simulator.step(action)
        self._check()
        return solved

    def _check(self) -> None:
        poses = {name: _numbers(pose) for name, pose in self.simulator.bodies().items()}
        if poses != self._client.state["bodies"]:
            raise ScenarioError(
                "the operator's simulator is not where the server's is: both have to run on one machine, "
                "with the same versions"
            )


class LiberoHand(Hand):
    """LIBERO's hand, about the first goal that is about a place.

    Args:
        mirror: where the task has been started.
        scene: of its simulator.
        rng: of the motions' details.
    """

    gain = 24.0
    travel_m = 0.27
    near_m = 0.085
    settle_steps = 2
    aside_m = (0.05, 0.07)

    def __init__(self, mirror: Mirror, scene: LiberoScene, rng: np.random.Generator):
        self._mirror, self._scene = mirror, scene
        self._goal = next(g for g in scene.goals if g.predicate[0] in PLACE_KINDS)
        self._expert = LiberoExpert(scene)
        self.support_m = mirror.simulator.workspace().support_m
        super().__init__(rng)

    def at(self) -> np.ndarray:
        """The grip site."""
        return self._scene.hand_m

    def object(self) -> np.ndarray:
        """The middle of what its body collides with."""
        cloud = self._scene.cloud_m(self._goal.item)
        return (cloud.min(0) + cloud.max(0)) / 2

    def goal(self) -> np.ndarray:
        """The region's middle, or the object's top."""
        return self._scene.center_m(self._goal.region)

    def other(self) -> np.ndarray:
        """The nearest other object."""
        here = self.object()
        rest = [self._scene.position_m(n) for n in self._scene.objects if n != self._goal.item]
        if not rest:
            raise Fumbled("the task has one object alone")
        return min(rest, key=lambda place: float(np.linalg.norm(place - here)))

    def target(self) -> np.ndarray:
        """The object that the goal names, or whose region it names."""
        for name in self._scene.objects:
            if self._goal.region.startswith(name):
                return self._scene.position_m(name)
        raise Fumbled("the place is part of a fixture")

    def over_m(self) -> float:
        """From its middle to above its top."""
        return float(np.ptp(self._scene.cloud_m(self._goal.item)[:, 2])) / 2 + _CLEAR_M

    def carried(self, far_m: float) -> bool:
        """Both fingers touch it, and it is no longer where it was."""
        moved = np.linalg.norm(self.object() - self.start) > far_m
        return bool(moved and self._scene.holds(self._goal.item))

    def move(self, velocity: np.ndarray, grip: float) -> bool:
        """One relative command without a turn."""
        return self._mirror.act(np.clip(np.array([*velocity, 0.0, 0.0, 0.0, grip]), -1.0, 1.0))

    def follow(self, t: int) -> bool:
        """The scripted expert's."""
        return self._mirror.act(self._expert.act())


def _numbers(pose: Pose) -> list[float]:
    return [*map(float, pose.position_m), *map(float, pose.quat_xyzw)]


def workable(task: Task) -> bool:
    """Whether the deviations are made for a task: something is picked up and placed, not into a drawer or
    through a door."""
    predicates = libero_goal(task.suite, task.name)
    places = [p for p in predicates if p[0] in PLACE_KINDS]
    shut = [p for p in predicates if p[0] in ("open", "close")]
    return bool(places) and not shut and "plate" not in places[0][1]


def record(
    out: Path, tasks: Sequence[Task], init_states: Sequence[int], ways: Sequence[str], size: int
) -> Counter[str]:
    """Records every way into a cell on every task, as far as it can be done.

    Args:
        out: candidate dataset.
        tasks: what to drive.
        init_states: of each way and task, in turn: each is tried until one succeeds.
        ways: of `DEVIATIONS`.
        size: of the dataset's pictures; 0 for none.

    Returns:
        Recordings by way.
    """
    starts: list[StartPoint] = []
    turns: list[Turn] = []
    for task in tasks:
        for k, way in enumerate(ways):
            turns.append(
                Turn(f"{task.suite}/{task.name}", way, range(len(starts), len(starts) + len(init_states)))
            )
            # Ways begin at different ones, so that scenarios of a task do not share theirs.
            for i in range(len(init_states)):
                state = init_states[(k + i) % len(init_states)]
                starts.append(first_state("libero", task.name, task.suite, init_state=state))
    config = TeleopConfig(
        out, "libero", OPERATOR, starts, port=0, rate_hz=1000.0, size=size, frame_stride=FRAME_STRIDE,
        options={"render_quality": "fast"},
    )  # fmt: skip
    simulator = LiberoSimulator(obs_type="state")

    def one(client: Client, number: int, how: Deviation, rng: np.random.Generator) -> str:
        start, mirror = starts[number], Mirror(simulator, client)
        scene = mirror.start(start, number)
        hand = LiberoHand(mirror, scene, rng)

        def attempts():
            expert = LiberoExpert(scene)
            yield lambda _t: mirror.act(expert.act())

        return drive(client, hand, how, STOP, attempts(), LIBERO_HORIZONS[start.task.suite])

    try:
        return record_turns(config, turns, one)
    finally:
        simulator.close()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--out", type=Path, required=True, help="folder of the candidate dataset")
    add("--tasks", nargs="+", default=[""], metavar="PART", help="of suite/name; all that can be driven")
    add("--init-states", default="16-19", help="tried in turn until one succeeds (%(default)s)")
    add("--ways", nargs="+", choices=DEVIATIONS, default=list(DEVIATIONS), metavar="WAY")
    add("--size", type=int, default=64, help="of the pictures; 0 for none, numbers alone (%(default)s)")
    args = parser.parse_args()
    tasks = [
        t
        for t in PLATFORM.tasks()
        if workable(t) and any(part in f"{t.suite}/{t.name}" for part in args.tasks)
    ]
    states = parse_numbers(args.init_states, "--init-states")
    made = record(args.out, tasks, states, args.ways, args.size)
    print(f"{made.total()} recordings: " + ", ".join(f"{n} {way}" for way, n in made.most_common()))


if __name__ == "__main__":
    main()
