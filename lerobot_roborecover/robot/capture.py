"""Runs a policy on a robot, always recording, while a person marks where something goes wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lerobot_roborecover.robot.connection import RobotLostError
from lerobot_roborecover.robot.console import Console
from lerobot_roborecover.robot.recorder import Recorder
from lerobot_roborecover.robot.restore import LivePictures
from lerobot_roborecover.robot.suggestions import FailureWatch
from lerobot_roborecover.utils.text import pluralize


def capture(
    robot: Any,
    context: Any,
    folder: Path,
    console: Console,
    *,
    episodes: int,
    limit_s: float,
    instruction: str,
    teleop: Any = None,
    watch: FailureWatch | None = None,
    say: Callable[[str], None] = print,
) -> int:
    """Records episodes into a LeRobotDataset.

    Args:
        robot: connected.
        context: of the policy (`policies.load_context`).
        folder: of the dataset; extended where it is there.
        console: takes `mark`, `end` and `stop`; shows which episode runs.
        episodes: how many to record.
        limit_s: of each.
        instruction: of the task.
        teleop: a connected teleoperator for takeovers, or None.
        watch: a detector that suggests moments, or None.
        say: takes lines.

    Returns:
        How many moments were marked.

    Raises:
        RobotLostError: the robot, a camera or the phone does not answer; what was recorded is kept.
    """
    from lerobot_roborecover.robot.rollout import RecordedRollout

    fps = context.runtime.cfg.fps
    recorder = Recorder(folder, f"rollout_{folder.name}", robot, context.data.dataset_features, fps)
    marked = 0
    if recorder.number:
        say(f"{folder} has {pluralize(recorder.number, 'episode')}; new ones are added")
    live_pictures = LivePictures(robot, console)
    for number in range(episodes):
        said = console.ask(
            "next",
            f"Episode {number + 1} of {episodes}: set the scene, then press Go.",
            ("go", "pause"),
            {"instruction": instruction},
            live_pictures,
        )
        if said.button == "pause":
            break
        console.release()
        if hasattr(robot, "new_scene"):
            robot.new_scene(robot.config.seed + recorder.number)
        buttons = ("mark", "end", *(("takeover", "handback") if teleop else ()))
        console.show(
            "capturing", "Press Mark the moment that something has gone wrong and lies still.", buttons,
            {"instruction": instruction, "limit_s": limit_s},
        )  # fmt: skip
        rollout = RecordedRollout(recorder, console, limit_s, instruction, teleop, watch=watch)
        try:
            rollout.setup(context)
            rollout.run(context)
        finally:
            rollout.teardown(context)
        end = rollout.end
        marked += len(end.marks)
        if end.episode is not None:
            say(
                f"episode {end.episode}: {pluralize(end.steps, 'frame')}, "
                f"{pluralize(len(end.marks), 'mark')}"
                + (f" at {end.marks}" if end.marks else "")
                + (f", the detector's alarm at {end.suggested}" if end.suggested is not None else "")
            )
        if end.ended in ("trouble", "policy"):
            raise RobotLostError(f"{end.problem}. Episodes up to here are in {folder}")
        if end.ended == "stop":
            console.ask("stopped", "The robot was stopped. Look at it, then press Go.", ("go",))
            console.release()
    if watch is not None and watch.mean_s > 1 / fps:
        say(
            f"the detector took {1000 * watch.mean_s:.0f} ms a step, and a control step has "
            f"{1000 / fps:.0f}: the policy ran slower than it would without"
        )
    console.show("over", f"{pluralize(marked, 'moment')} marked in {folder}.")
    return marked
