"""Renders the frames of an episode: each scenario's prefix, its observations drawn from the replay.

Frame i of an episode is the observation before action i, as LeRobot's own env and processors of the platform
give it to a policy. Two columns lie outside `observation.` and `action`, where training does not see them:
the exact float64 action, and the row of the frame's scenario in `meta/roborecover/scenarios.parquet`.
`encoding.py` writes them as a LeRobotDataset (v3.0).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from lerobot_roborecover.datasets.frames import LastFrames, Tail
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.simulator import Observation, Simulator, iter_steps
from lerobot_roborecover.scenario import Scenario

EXACT_ACTION = "roborecover.action"
"""(A,) float64: the recorded action. LeRobot's own `action` column is its float32 rounding."""
SCENARIO_INDEX = "roborecover.scenario_index"
"""(1,) int64: row of the scenario in `scenarios.parquet`."""

type Frame = Mapping[str, np.ndarray]
"""One time step by LeRobot feature name: `observation.*`, images (H, W, 3) uint8 and vectors (D,) float32."""


def render_prefix(
    simulator: Simulator, scenario: Scenario, last: list[LastFrames] | None = None
) -> Iterator[Frame]:
    """Replays a scenario's prefix and yields the observation before each of its actions.

    Args:
        simulator: of the scenario's platform; left at the recovery point.
        scenario: a prefix of t actions yields t frames.
        last: takes the last frames up to the recovery point, losslessly, once the last frame is drawn.
    """
    tail = Tail(scenario.platform)
    steps = len(scenario.prefix)
    for step in iter_steps(simulator, scenario.rollout):
        if step == steps and last is None:
            return
        observation = simulator.observe()
        tail.add(observation)
        if step < steps:
            yield to_frame(scenario.platform, observation)
    if last is not None:
        last.append(tail.frames(scenario))


def to_frame(platform: str, observation: Observation) -> dict[str, np.ndarray]:
    """A raw observation with the names and in the form that policies of the platform see, unbatched."""
    from lerobot.envs.utils import preprocess_observation

    seen = preprocess_observation(_batched(observation))
    seen = platform_named(platform).process_observation(seen)
    frame = {}
    for key, value in seen.items():
        array = value[0].numpy()
        if array.ndim == 3:
            # LeRobot gives images as (3, H, W) in [0, 1]; rounding recovers the rendered bytes exactly.
            array = np.rint(array.transpose(1, 2, 0) * 255).astype(np.uint8)
        frame[key] = array
    return frame


def features_of(frame: Frame, action_dim: int) -> dict[str, dict[str, Any]]:
    """LeRobot's feature table for frames like this one."""

    def vector(dtype: str, size: int) -> dict[str, Any]:
        return {"dtype": dtype, "shape": (size,), "names": None}

    features: dict[str, dict[str, Any]] = {}
    for key, value in frame.items():
        if value.ndim == 3:
            features[key] = {"dtype": "video", "shape": value.shape, "names": ["height", "width", "channels"]}
        else:
            features[key] = vector("int64" if value.dtype.kind == "i" else "float32", len(value))
    features["action"] = vector("float32", action_dim)
    features[EXACT_ACTION] = vector("float64", action_dim)
    features[SCENARIO_INDEX] = vector("int64", 1)
    return features


def _batched(observation: Any) -> Any:
    """The observation with a leading axis of one in every array, as a vector env gives it."""
    if isinstance(observation, Mapping):
        return {key: _batched(value) for key, value in observation.items()}
    return np.asarray(observation)[None]
