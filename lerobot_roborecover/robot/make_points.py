"""`robot points`: from moments of recorded episodes to a set of recovery points."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.robot.annotate import annotate, voted
from lerobot_roborecover.robot.episodes import Episodes, PointRequest
from lerobot_roborecover.robot.options import RobotPointsOptions
from lerobot_roborecover.robot.points import write_points
from lerobot_roborecover.robot.recorder import DETECTOR, marks
from lerobot_roborecover.scenario import DeviationType, ScenarioError, Stage
from lerobot_roborecover.utils.text import next_command, pluralize


def make_points(options: RobotPointsOptions, say: Callable[[str], None]) -> int:
    """Writes the points that the options ask for.

    Raises:
        OptionError: a moment cannot be read, or it is not said to be quasi-static.
        ScenarioError: the dataset cannot be used, or has no marks.
    """
    if options.annotators:
        annotate(options, say)
        return 0
    if options.votes_needed is None and not options.quasi_static:
        raise OptionError(
            "--quasi-static: look at each moment first. Only where nothing is falling, sliding or held by "
            "friction alone can a hand put the scene back; then say so with this option"
        )
    episodes = Episodes(options.dataset)
    if options.calibration is not None:
        sha256 = _calibration_sha256(options.calibration)
        episodes.notes = replace(episodes.notes, calibration_sha256=sha256)
    if options.votes_needed is not None:
        requests = voted(options, say)
    else:
        requests = [_parse(text, options) for text in options.at] or [
            _request(m["episode"], m["frame"], options.stage, options.deviation, options)
            for m in marks(options.dataset)
            if m["by"] != DETECTOR
        ]
    if not requests:
        suggested = [f"{m['episode']}:{m['frame']}" for m in marks(options.dataset)]
        hint = f" (a detector suggests {', '.join(suggested[:8])})" if suggested else ""
        raise ScenarioError(
            f"{options.dataset} has no marks of a person. Name moments with --at EPISODE:FRAME{hint}, or "
            "capture with `roborecover robot capture` and press Mark"
        )
    made = [episodes.point(request, options.time_limit) for request in requests]
    write_points(options.out, [s for s, _ in made], {s.id: pictures for s, pictures in made})
    for scenario, pictures in made:
        say(f"{scenario.id}: {scenario.cell}, {pluralize(len(pictures), 'camera')}")
    say(f"{pluralize(len(made), 'point')} in {options.out}")
    say(next_command(["robot", "restore", f"--points={options.out}", "--robot.type=TYPE"]))
    return 0


def _parse(text: str, options: RobotPointsOptions) -> PointRequest:
    parts = text.split(":")
    if len(parts) not in (2, 4) or not all(p.isascii() and p.isdigit() for p in parts[:2]):
        raise OptionError(f"--at {text!r:.60}: write EPISODE:FRAME, or EPISODE:FRAME:STAGE:TYPE")
    stage, deviation = (parts[2], parts[3]) if len(parts) == 4 else (options.stage, options.deviation)
    return _request(int(parts[0]), int(parts[1]), stage, deviation, options)


def _request(
    episode: int, frame: int, stage: str, deviation: str, options: RobotPointsOptions
) -> PointRequest:
    for label, value, known in (("stage", stage, Stage), ("type", deviation, DeviationType)):
        if value not in list(known):
            raise OptionError(f"--{label} {value!r:.40}: not one of {', '.join(known)}")
    return PointRequest(
        episode,
        frame,
        stage,
        deviation,
        source_policy=options.source_policy,
        quasi_static=options.quasi_static,
    )


def _calibration_sha256(path: Path) -> str:
    """Hash of a calibration file's content, as of the robot that has loaded it."""
    try:
        found = json.loads(path.read_text("utf-8"))
    except ValueError as err:
        raise OptionError(f"--calibration {path}: not LeRobot's calibration file ({err})") from None
    return hashlib.sha256(json.dumps(found, sort_keys=True).encode()).hexdigest()
