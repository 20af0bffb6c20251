"""The scripted operator: its deviations on the real simulator, and what the rules call them."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from lerobot_roborecover.curation.annotation.annotators import LABELERS
from lerobot_roborecover.curation.annotation.features import EpisodeFeatures, EpisodeInfo, frames_to_look_at
from lerobot_roborecover.curation.annotation.rules import judge
from lerobot_roborecover.curation.annotation.traces import traces
from lerobot_roborecover.replay.recorder import Steps
from lerobot_roborecover.scenario import Reset

pytestmark = pytest.mark.metaworld
STOP = 56


class Recorder:
    """Controls of a simulator at hand, which records what is done with them."""

    def __init__(self, simulator):
        self.simulator, self.actions, self.poses, self.solved = simulator, [], [], []
        self._record()

    def _record(self) -> None:
        self.poses.append(self.simulator.bodies())
        self.solved.append(self.simulator.succeeded())

    def low_dim(self) -> np.ndarray:
        return self.simulator.low_dim()

    def point(self, name: str) -> np.ndarray:
        return np.array(self.poses[-1][name].position_m)

    def names(self) -> list[str]:
        return list(self.poses[-1])

    def act(self, action: np.ndarray) -> bool:
        self.simulator.step(action)
        self.actions.append(action)
        self._record()
        return self.solved[-1]

    def look(self, eye: str) -> EpisodeFeatures:
        """The recording as the page shows it."""
        count = len(self.actions)
        poses = {
            n: np.array([[*p[n].position_m, *p[n].quat_xyzw] for p in self.poses]) for n in self.poses[0]
        }
        steps = Steps(poses, np.array(self.solved), np.zeros(count, np.int8))
        shown = traces("metaworld", np.array(self.actions), steps, 80)
        look = EpisodeFeatures(EpisodeInfo("it", "", count - 1, 80.0, False, human=True))
        for f in frames_to_look_at(LABELERS[eye].first_look, 80, count - 1):
            hand = {"speed": shown.eef_speed_m_s[f], "a3": shown.gripper["a3"][f]}
            look.readings[f] = {"hand": hand}
            for name, place in shown.places.items():
                values = {"reach": place.reach_m, "moved": place.moved_m, "height": place.height_m}
                values |= {} if place.goal_m is None else {"goal": place.goal_m}
                look.readings[f][name] = {key: float(v[f]) for key, v in values.items()}
        return look


@pytest.mark.parametrize(
    ("task", "way"),
    [
        ("push-v3", "dropped"),
        ("push-v3", "too-high"),
        ("hammer-v3", "wrong-place"),
        ("hammer-v3", "wrong-part"),
    ],
)
def test_a_deviation_is_what_the_rules_call_it(task, way):
    from lerobot_roborecover.platforms.metaworld import PLATFORM
    from lerobot_roborecover.platforms.metaworld.simulator import MetaworldSimulator
    from recipes.deviations import DEVIATIONS
    from recipes.metaworld.scripted_operator import MetaworldHand

    simulator = MetaworldSimulator(obs_type="state")
    simulator.reset(PLATFORM.task(task), Reset(seed=500))
    controls, how = Recorder(simulator), DEVIATIONS[way]
    hand = MetaworldHand(controls, task, np.random.default_rng(1))
    how.make(hand)
    began = len(controls.actions)
    hand.hold(STOP, how.grip)
    found = judge(controls.look("auto-1"), LABELERS["auto-1"])
    simulator.close()
    assert (found.stage, found.deviation) == (how.stage, how.deviation)
    # The hand is slow before it stands still.
    assert began - 25 <= found.step <= began + 25


def test_a_stopped_operator_goes_on(tmp_path, monkeypatch):
    from contextlib import nullcontext
    from types import SimpleNamespace

    import recipes.scripted_operator as operator
    from recipes.deviations import Fumbled
    from recipes.scripted_operator import Turn, record

    monkeypatch.setattr(operator, "_server", lambda config: nullcontext("http://"))
    monkeypatch.setattr(operator, "Client", lambda address: nullcontext(None))
    starts = [SimpleNamespace(reset=SimpleNamespace(seed=n, init_state_index=n)) for n in range(6)]
    config = SimpleNamespace(dataset=tmp_path / "set", starts=starts)
    turns = [Turn("suite/task", "dropped", (0, 1)), Turn("suite/task", "beside", (2, 3)),
             Turn("suite/task", "astray", (4, 5))]  # fmt: skip
    asked: list[int] = []

    def one(stop_at: int | None):
        def attempt(client, number, how, rng) -> str:
            if number == stop_at:
                raise KeyboardInterrupt
            asked.append(number)
            if number in (0, 4, 5):
                raise Fumbled("not from there")
            return f"recording-{number}"

        return attempt

    with pytest.raises(KeyboardInterrupt):
        record(config, turns, one(stop_at=2))
    assert asked == [0, 1]
    assert record(config, turns, one(None)) == {"dropped": 1, "beside": 1}
    assert asked == [0, 1, 2, 4, 5], "nothing is driven twice"
    assert record(config, turns, one(None)) == {"dropped": 1, "beside": 1}
    assert len(asked) == 5
    # Without the recordings it begins anew.
    shutil.rmtree(tmp_path / "set.recordings")
    assert record(config, turns, one(None)) == {"dropped": 1, "beside": 1}
    assert len(asked) == 10
