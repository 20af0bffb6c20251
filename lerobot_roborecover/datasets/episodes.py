"""Writes scenarios as a LeRobotDataset (v3.0): each prefix an episode, its observations rendered from the
replay.

Frame i of an episode is the observation before action i, as LeRobot's own env and processors of the platform
give it to a policy. Two columns lie outside `observation.` and `action`, where training does not see them:
the exact float64 action, and the row of the frame's scenario in `meta/roborecover/scenarios.parquet`. LeRobot
is imported only here, and only when something is written.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.datasets.frames import LastFrames, Tail
from lerobot_roborecover.datasets.write import write_scenarios
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.simulator import Observation, Simulator
from lerobot_roborecover.platforms.stepping import iter_steps
from lerobot_roborecover.scenario import Scenario, ScenarioError

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


def write_episodes(
    root: str | os.PathLike[str],
    scenarios: Sequence[Scenario],
    simulator_factory: Callable[[], Simulator],
    *,
    fps: int | None = None,
    description: str = "",
    license: str | None = None,
) -> Path:
    """Renders every scenario's prefix and writes the complete dataset: episodes and `meta/roborecover/`.

    Args:
        root: the dataset's folder; must be new or empty.
        scenarios: of one platform, each with a prefix of at least one action.
        simulator_factory: makes the simulator that renders; its observation options decide the features.
        fps: frame rate of the episodes; the simulator's control rate by default.
        description: free text for the manifest.
        license: SPDX identifier, or None where none is decided.

    Raises:
        ScenarioError: the folder is not empty, a prefix is, or the set is invalid.
        SimulatorError: a scenario cannot be replayed.
    """
    simulator = simulator_factory()
    last: list[LastFrames] = []
    try:
        return write_scenarios(
            root,
            scenarios,
            description=description,
            license=license,
            episodes=(render_prefix(simulator, scenario, last) for scenario in scenarios),
            frames=last,
            fps=fps or round(simulator.control_hz),
        )
    finally:
        simulator.close()


def write_lerobot_dataset(
    root: Path,
    scenarios: Sequence[Scenario],
    episodes: Iterable[Iterable[Frame]],
    fps: int,
    *,
    first_index: int = 0,
) -> None:
    """Writes one episode per scenario as a LeRobotDataset in a folder that does not exist yet.

    Args:
        root: the dataset's folder.
        scenarios: in the order of `scenarios.parquet`.
        episodes: for each scenario its frames, as many as its prefix has actions.
        fps: frame rate.
        first_index: row of the first scenario in `scenarios.parquet`, where these are a part of a set.

    Raises:
        ScenarioError: numbers of scenarios, actions, frames and video frames disagree.
    """
    from lerobot_roborecover.datasets.encoding import Episode, EpisodeWriter

    with EpisodeWriter(root, fps, scenarios[0].platform) as writer:
        for index, (scenario, frames) in enumerate(_pair(scenarios, episodes), first_index):
            writer.write(
                Episode(
                    f"scenario {scenario.id}", scenario.prefix, frames, index, scenario.task.instruction, {}
                )
            )


def _pair(
    scenarios: Sequence[Scenario], episodes: Iterable[Iterable[Frame]]
) -> Iterator[tuple[Scenario, Iterable[Frame]]]:
    for scenario, frames in zip_longest(scenarios, episodes):
        if scenario is None or frames is None:
            raise ScenarioError(
                f"{len(scenarios)} scenarios, but {'more' if scenario is None else 'fewer'} episodes; "
                "there is one episode for each scenario"
            )
        yield scenario, frames


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
