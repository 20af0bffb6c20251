"""LeRobot's writer of episodes, without its loss of frames.

LeRobot 0.6.1 encodes while frames come in and throws a frame away when the encoder's queue of 30 has been
full for 0.1 s (`StreamingVideoEncoder.feed_frame`), as befits a robot that does not wait. Here frames come
from files and simulators, which do: a frame waits until there is room. When an episode ends, the frames that
the encoder really wrote are counted against its steps. LeRobot is imported here, and this module only when
something is written.
"""

from __future__ import annotations

import queue
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from types import TracebackType

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import StreamingVideoEncoder

from lerobot_roborecover.datasets.episodes import EXACT_ACTION, SCENARIO_INDEX, Frame, features_of
from lerobot_roborecover.datasets.lerobot_folder import check_lerobot_folder, local_repo_id
from lerobot_roborecover.datasets.video_frames import REMEDY, check_frames
from lerobot_roborecover.scenario import Scenario, ScenarioError

QUEUE = 30
"""Frames of a camera that may wait for the encoder: some 6 MB at 256 x 256."""
_LOOK_S = 1.0
"""How often a waiting frame looks whether the encoder still lives."""


class BlockingEncoder(StreamingVideoEncoder):
    """The streaming encoder, with frames that wait for room instead of being thrown away."""

    def feed_frame(self, video_key: str, image: np.ndarray) -> None:
        """Hands a frame over as soon as there is room.

        Raises:
            ScenarioError: the encoder has died.
        """
        # When its queue is full, LeRobot's encoder waits 0.1 s and then drops the frame. So `_put` waits for
        # room, which no other thread takes up.
        self._put(video_key, np.array(image))

    def finish_episode(self) -> dict[str, tuple[Path, dict | None]]:
        """Ends the videos; waits as long as the encoder works, where LeRobot gives up after two minutes.

        Raises:
            ScenarioError: the encoder has died.
        """
        for key, thread in self._threads.items():
            self._put(key, None)
            thread.join()
        return super().finish_episode()

    def _put(self, key: str, item: np.ndarray | None) -> None:
        if not self._episode_active:
            raise RuntimeError("no episode has begun; frames belong to one")
        while True:
            if not self._threads[key].is_alive():
                raise ScenarioError(
                    f"camera {key}: the video encoder died ({self._last_words(key)}); see that the disk has "
                    "room and run it again"
                )
            try:
                return self._frame_queues[key].put(item, timeout=_LOOK_S)
            except queue.Full:
                continue

    def _last_words(self, key: str) -> str:
        try:
            return str(self._result_queues[key].get_nowait()[1])
        except queue.Empty:
            return "it left no message"


@dataclass(frozen=True)
class Episode:
    """One episode to be written, of T steps."""

    name: str
    """For messages, e.g. `scenario abc`."""
    actions: np.ndarray
    """(T, A) float64."""
    frames: Iterable[Frame]
    """T observations, one before each action."""
    scenario_index: int
    instruction: str
    columns: Mapping[str, np.ndarray]
    """Columns of its own, (T,) each: bool, or numbers that are written as float32."""


def join_datasets(root: Path, sources: Sequence[Path], steps: Sequence[int]) -> None:
    """Joins LeRobotDatasets into a new one without encoding anything again, and counts its frames.

    Args:
        root: the new dataset's folder.
        sources: in the order in which their episodes follow each other.
        steps: of all episodes, in that order.

    Raises:
        ScenarioError: they do not fit together, or an episode's video has not one frame a step.
    """
    from lerobot.datasets.aggregate import aggregate_datasets

    quiet_video()
    for source in sources:
        if not check_lerobot_folder(source).tasks_in_order:
            # LeRobot would take the instruction of another row.
            raise ScenarioError(
                f"{source}/meta/tasks.parquet is not in order of task_index; write its rows in that order"
            )
    try:
        aggregate_datasets([local_repo_id(s) for s in sources], local_repo_id(root), list(sources), root)
    except ValueError as err:
        raise ScenarioError(f"the datasets cannot be joined: {err}") from err
    check_frames(root, steps, thorough=True)


def quiet_video() -> None:
    """Errors only from FFmpeg's libraries, which report on every video that they open or close."""
    import av

    av.logging.set_libav_level(av.logging.ERROR)


def _dtype(column: np.ndarray) -> str:
    return "bool" if np.asarray(column).dtype == bool else "float32"


class EpisodeWriter:
    """Writes episodes as a LeRobotDataset in a folder that does not exist yet.

    Args:
        root: the dataset's folder.
        fps: frame rate.
        robot_type: the platform.
    """

    def __init__(self, root: Path, fps: int, robot_type: str):
        quiet_video()
        self._root, self._fps, self._robot_type = root, fps, robot_type
        self._dataset: LeRobotDataset | None = None
        self._steps: list[int] = []

    def write(self, episode: Episode) -> None:
        """Writes an episode.

        Raises:
            ScenarioError: it has not one frame before each action, or a camera's video another number of
                frames than that; or its columns are not those of the first episode.
        """
        dataset, steps, written = self._dataset, len(episode.actions), 0
        for frame in episode.frames:
            if written == steps:
                written += 1
                break
            if dataset is None:
                dataset = self._dataset = self._create(episode, frame)
            action = episode.actions[written]
            own = {k: np.array([v[written]], dtype=_dtype(v)) for k, v in episode.columns.items()}
            row = {
                **frame,
                "action": action.astype(np.float32),
                EXACT_ACTION: action,
                SCENARIO_INDEX: np.array([episode.scenario_index], dtype=np.int64),
                "task": episode.instruction,
                **own,
            }
            try:
                dataset.add_frame(row)
            except ScenarioError:
                raise
            except ValueError as err:
                raise ScenarioError(
                    f"{episode.name}, step {written}: its columns are not those of the first episode "
                    f"({' '.join(str(err).split())[:300]}); write episodes with other cameras or shapes as a "
                    "dataset of their own"
                ) from err
            written += 1
        if dataset is None or written != steps or not written:
            raise ScenarioError(
                f"{episode.name}: {steps} actions, but {written if written <= steps else 'more'} frames; an "
                "episode has one frame before each action, and at least one"
            )
        dataset.save_episode()
        self._check_latest(dataset.meta, episode.name, steps)
        self._steps.append(steps)

    def _create(self, episode: Episode, frame: Frame) -> LeRobotDataset:
        features = features_of(frame, episode.actions.shape[1])
        features |= {
            k: {"dtype": _dtype(v), "shape": (1,), "names": None} for k, v in episode.columns.items()
        }
        dataset = LeRobotDataset.create(
            repo_id=local_repo_id(self._root),
            fps=self._fps,
            features=features,
            root=self._root,
            robot_type=self._robot_type,
            streaming_encoding=True,
        )
        writer = dataset.writer
        theirs = None if writer is None else writer._streaming_encoder
        if writer is not None and theirs is not None:
            writer._streaming_encoder = BlockingEncoder(
                theirs.fps,
                theirs._rgb_encoder,
                theirs._depth_encoder,
                queue_maxsize=QUEUE,
                encoder_threads=theirs._encoder_threads,
            )
        return dataset

    def _check_latest(self, meta: LeRobotDatasetMetadata, name: str, steps: int) -> None:
        """The length of the video just written, which is where LeRobot begins the next one."""
        latest = meta.latest_episode
        for camera in meta.video_keys:
            if latest is None:
                raise ScenarioError(f"{name} (episode {len(self._steps)}): nothing of it was kept; {REMEDY}")
            begin, end = (latest[f"videos/{camera}/{part}_timestamp"][0] for part in ("from", "to"))
            frames = round((end - begin) * self._fps)
            if frames != steps:
                raise ScenarioError(
                    f"{name} (episode {len(self._steps)}), camera {camera}: the encoder wrote {frames} video "
                    f"frames for {steps} steps; {REMEDY}"
                )

    def close(self) -> None:
        """Ends the dataset; without it the parquet files have no footer."""
        if self._dataset is not None:
            self._dataset.finalize()

    def __enter__(self) -> EpisodeWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        if kind is None and self._dataset is not None:
            check_frames(self._root, self._steps, thorough=True)


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
