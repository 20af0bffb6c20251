"""No video frame is lost on its way into a dataset, and a dataset that lacks one is refused by name."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.candidates_write import merge_candidates
from lerobot_roborecover.curation.validate.dataset import validate_dataset
from lerobot_roborecover.curation.validate.request import ValidationRequest
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.datasets.publish import PublishConfig, plan_publish
from lerobot_roborecover.datasets.trajectories import read_trajectories
from lerobot_roborecover.datasets.video_frames import check_frames
from lerobot_roborecover.scenario import ScenarioError
from tests.support.candidate_files import CAMERAS, FPS, candidate_dataset, numbered_frame
from tests.support.factories import fake_scenario

STEPS = 20
EPISODES = Path("meta/episodes/chunk-000/file-000.parquet")


@pytest.fixture
def rollouts(tmp_path):
    """Three episodes of `STEPS` frames and two cameras."""
    return candidate_dataset(tmp_path / "rollouts", 3, steps=STEPS)


def video(root: Path, numbers: list[int]) -> Path:
    """Writes the first camera's video anew with frames at these places of the grid of times."""
    from fractions import Fraction

    import av

    path = root / "videos" / CAMERAS[0] / "chunk-000" / "file-000.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"preset": "ultrafast", "bf": "0"})
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv420p"
        for number in numbers:
            frame = av.VideoFrame.from_ndarray(numbered_frame(number, 0, 0), format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return root


def shorter(root: Path, episode: int) -> Path:
    """As LeRobot leaves it: one frame of an episode was dropped, and the next begins where it ended."""
    table = pq.read_table(root / EPISODES).to_pydict()
    for part in ("from_timestamp", "to_timestamp"):
        column = table[f"videos/{CAMERAS[0]}/{part}"]
        for later in range(episode + (part == "from_timestamp"), len(column)):
            column[later] -= 1 / FPS
    pq.write_table(pa.table(table), root / EPISODES)
    return video(root, list(range(3 * STEPS - 1)))


def test_a_whole_dataset_is_counted(rollouts):
    assert check_frames(rollouts) == check_frames(rollouts, [STEPS] * 3, thorough=True) == 3 * STEPS * 2
    assert check_frames(rollouts / "meta") == 0, "no LeRobotDataset, nothing to check"


@pytest.mark.parametrize("thorough", [False, True])
def test_one_frame_short_is_refused_by_name(rollouts, thorough):
    shorter(rollouts, 1)
    expected = rf"episode 1, camera {CAMERAS[0]}: {STEPS - 1} video frames for {STEPS} steps.*again, or take"
    with pytest.raises(ScenarioError, match=expected):
        check_frames(rollouts, thorough=thorough)


def test_a_hole_a_lost_end_and_a_missing_file_are_found(rollouts):
    video(rollouts, [n for n in range(3 * STEPS) if n != STEPS + 3])
    with pytest.raises(ScenarioError, match=rf"episode 1, camera .*: {STEPS - 1} video frames"):
        check_frames(rollouts)
    video(rollouts, list(range(3 * STEPS - 2)))
    with pytest.raises(ScenarioError, match=rf"episode 2, camera .*: {STEPS - 2} video frames"):
        check_frames(rollouts)
    (rollouts / "videos" / CAMERAS[0] / "chunk-000" / "file-000.mp4").unlink()
    with pytest.raises(ScenarioError, match=r"episode 0, camera .* is missing"):
        check_frames(rollouts)


@pytest.mark.lerobot
def test_it_is_neither_read_nor_joined_nor_validated_nor_published(rollouts, tmp_path):
    candidates = read_candidates(rollouts)
    scenarios = [fake_scenario(0), fake_scenario(1)]
    shorter(rollouts, 0)
    refused = rf"episode 0, camera {CAMERAS[0]}: {STEPS - 1} video frames for {STEPS} steps"
    with pytest.raises(ScenarioError, match=refused):
        read_trajectories(rollouts)
    assert len(read_trajectories(rollouts, videos=False).rows) == len(candidates)
    with pytest.raises(ScenarioError, match=refused):
        read_candidates(rollouts)
    with pytest.raises(ScenarioError, match=refused):
        merge_candidates(tmp_path / "joined", [rollouts])
    with pytest.raises(ScenarioError, match=refused):
        plan_publish(rollouts, PublishConfig("lab/x", license="mit"), to_show=True)
    dataset = write_scenarios(tmp_path / "set", scenarios)
    (tmp_path / "trials").mkdir()
    with pytest.raises(ScenarioError, match=refused):
        validate_dataset(
            ValidationRequest(
                dataset=dataset,
                trials_folder=tmp_path / "trials",
                out=tmp_path / "out",
                candidates=[rollouts],
            )
        )


@pytest.fixture
def stalled(monkeypatch):
    """Every encoder sleeps before its first frame, and little may wait for it."""
    from lerobot.datasets import video_utils

    from lerobot_roborecover.datasets import encoding

    class Stalled(video_utils._CameraEncoderThread):
        def run(self):
            time.sleep(0.5)
            super().run()

    monkeypatch.setattr(video_utils, "_CameraEncoderThread", Stalled)
    monkeypatch.setattr(encoding, "QUEUE", 2)
    return encoding


def write(root: Path, steps: int = 12) -> Path:
    from lerobot_roborecover.datasets.encoding import Episode, EpisodeWriter

    frames = [{"observation.images.top": numbered_frame(n, 0, 0)} for n in range(steps)]
    with EpisodeWriter(root, FPS, "fake") as writer:
        for number in range(2):
            writer.write(Episode(f"rollout {number}", np.zeros((steps, 2)), frames, -1, "push", {}))
    return root


@pytest.mark.lerobot
def test_frames_wait_for_a_stalled_encoder(stalled, tmp_path):
    assert check_frames(write(tmp_path / "set"), [12, 12], thorough=True) == 24


@pytest.mark.lerobot
def test_what_the_encoder_dropped_is_not_written(stalled, tmp_path, monkeypatch):
    """With LeRobot's own way of feeding: it drops what a stalled encoder has no room for."""
    from lerobot.datasets.video_utils import StreamingVideoEncoder

    monkeypatch.setattr(stalled, "BlockingEncoder", StreamingVideoEncoder)
    with pytest.raises(ScenarioError, match=r"rollout 0 \(episode 0\), camera .*wrote \d+ video.* for 12 st"):
        write(tmp_path / "set")


@pytest.mark.lerobot
def test_an_encoder_that_dies_is_no_endless_wait(stalled, tmp_path, monkeypatch):
    from lerobot.datasets import video_utils

    def dies(self):
        self.result_queue.put(("error", "the disk is full"))

    monkeypatch.setattr(video_utils._CameraEncoderThread, "run", dies)
    with pytest.raises(ScenarioError, match=r"encoder died.*the disk is full"):
        write(tmp_path / "set")
