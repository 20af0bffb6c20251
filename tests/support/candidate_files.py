"""Candidate datasets for tests: the fake simulator's rollouts in LeRobot's layout, without importing LeRobot.

Each frame shows its own number, so that a test can tell which one a page or a decoder gives.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_roborecover.curation.candidates import Candidate, Suggestion
from lerobot_roborecover.curation.candidates_write import write_candidate_metadata
from lerobot_roborecover.curation.funnel import Decision, record_decisions
from lerobot_roborecover.curation.rollout import record
from lerobot_roborecover.datasets.episodes import EXACT_ACTION, SCENARIO_INDEX
from lerobot_roborecover.datasets.trajectories import TrajectoryRow, actions_sha256
from lerobot_roborecover.datasets.trajectory_write import write_metadata
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.replay.recorder import Steps
from lerobot_roborecover.scenario import Reset, Task

STEPS = 45
SIDE = 64
FPS = 20
CAMERAS = ("observation.images.top", "observation.images.wrist")
_CLIPS = 3
_BITS = 8


def numbered_frame(number: int, clip: int, camera: int) -> np.ndarray:
    """A (SIDE, SIDE, 3) picture: a row of white and black blocks for the number, one below for the clip."""
    frame = np.full((SIDE, SIDE, 3), (70, 90, 110 + 60 * camera), np.uint8)
    width = SIDE // _BITS
    for bit in range(_BITS):
        columns = slice(bit * width, (bit + 1) * width)
        frame[8:24, columns] = 255 * (number >> bit & 1)
        frame[32:48, columns] = 255 * (clip >> bit & 1)
    return frame


def number_of(frame: np.ndarray) -> tuple[int, int]:
    """The number and the clip that a picture shows."""
    middles = [bit * SIDE // _BITS + SIDE // _BITS // 2 for bit in range(_BITS)]
    rows = (frame[y, middles].mean(-1) > 128 for y in (16, 40))
    number, clip = (sum(1 << bit for bit, on in enumerate(row) if on) for row in rows)
    return number, clip


@lru_cache(maxsize=8)
def rollout(index: int, steps: int = STEPS) -> tuple[np.ndarray, Steps]:
    """Actions and steps of one of a few rollouts: the puck is pushed, then nothing moves any more."""
    task = fake_task(index)
    rng = np.random.default_rng(index)
    actions = [rng.uniform(-1, 1, 2) if t < steps // 2 else np.zeros(2) for t in range(steps)]
    made = record(
        make_simulator("fake"), task, Reset(seed=index, settle_steps=2), lambda t: actions[t],
        steps=steps - 2, settle_action=np.zeros(2), stop_when_solved=False,
    )  # fmt: skip
    return made.rollout.actions, made.steps


def fake_task(index: int) -> Task:
    """Push left or push right."""
    return Task("fake", "toy", ("push-left", "push-right")[index % 2], "push the puck to the goal", 45)


def candidate(index: int) -> Candidate:
    """Natural ones with a suggestion of a model, every fifth human-made."""
    source = "human" if index % 5 == 4 else ("natural", "perturbed")[index % 2]
    by_model = (Suggestion(17, "the arm stops", "model", "Contact", "Wrong Pose"),)
    return Candidate(f"ep-{index:04d}", source, suggestions=by_model)


def candidate_dataset(
    root: Path,
    count: int,
    *,
    steps: int = STEPS,
    dropped: tuple[int, ...] = (),
    picture: Callable[[int, int, int], np.ndarray] = numbered_frame,
) -> Path:
    """Writes a dataset of `count` candidates; those of `dropped` are excluded by a rule.

    Args:
        root: a new folder.
        count: candidates; they share three clips in turn.
        steps: frames of each.
        dropped: numbers of those that a rule has excluded.
        picture: makes a frame from its number, clip and camera.
    """
    side = picture(0, 0, 0).shape[0]
    parts = [rollout(i % 6, steps) for i in range(count)]
    for camera, key in enumerate(CAMERAS):
        path = root / "videos" / key / "chunk-000" / "file-000.mp4"
        path.parent.mkdir(parents=True)
        write_video(path, [picture(n, clip, camera) for clip in range(_CLIPS) for n in range(steps)], FPS)
    features = {key: {"dtype": "video", "shape": [side, side, 3], "names": None} for key in CAMERAS}
    features |= {"action": {"dtype": "float32", "shape": [2], "names": None}}
    (root / "meta").mkdir()
    info = {"codebase_version": "v3.0", "fps": FPS, "features": features, "total_episodes": count}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    clips = {
        f"videos/{key}/{part}": value
        for key in CAMERAS
        for part, value in {
            "chunk_index": [0] * count,
            "file_index": [0] * count,
            "from_timestamp": [(i % _CLIPS) * steps / FPS for i in range(count)],
            "to_timestamp": [(i % _CLIPS + 1) * steps / FPS for i in range(count)],
        }.items()
    }
    episodes = {"episode_index": list(range(count)), "length": [steps] * count}
    _table(root / "meta/episodes/chunk-000/file-000.parquet", {**episodes, **clips})
    _table(
        root / "data/chunk-000/file-000.parquet",
        {
            "episode_index": np.repeat(np.arange(count), steps).tolist(),
            "frame_index": list(range(steps)) * count,
            EXACT_ACTION: pa.array(np.concatenate([a for a, _ in parts]).tolist()),
            SCENARIO_INDEX: [-1] * (count * steps),
        },
    )
    rows = [
        TrajectoryRow(
            asdict(fake_task(i % 6)), "noise", steps, bool(parts[i][1].solved[-1]),
            actions_sha256(parts[i][0]),
            reset={"seed": i % 6, "init_state_index": None, "settle_steps": 2, "fixtures": {}},
        )
        for i in range(count)
    ]  # fmt: skip
    write_metadata(root, "rollouts", [], rows)
    write_candidate_metadata(root, [candidate(i) for i in range(count)], (s for _, s in parts), {"fake": "1"})
    record_decisions(
        root,
        (
            Decision(
                f"ep-{i:04d}", "collect", "dropped" if i in dropped else "kept", "stuck" * (i in dropped)
            )
            for i in range(count)
        ),
    )
    return root


def write_video(path: Path, frames: list[np.ndarray], fps: int) -> None:
    """Encodes frames as LeRobot does, but with the fastest codec there is."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            "libx264", rate=fps, options={"crf": "18", "preset": "ultrafast", "g": "10"}
        )
        stream.width, stream.height, stream.pix_fmt = frames[0].shape[1], frames[0].shape[0], "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode(None))


def _table(path: Path, columns: dict) -> None:
    path.parent.mkdir(parents=True)
    pq.write_table(pa.table(columns), path)
