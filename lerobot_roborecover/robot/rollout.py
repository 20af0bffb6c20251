"""One rollout on a robot: LeRobot's loop, recorded, watched for trouble, ended by a person or by time."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame

from lerobot_roborecover.robot.clock import clock_of
from lerobot_roborecover.robot.connection import RobotLostError, asking, camera_names
from lerobot_roborecover.robot.console import Console
from lerobot_roborecover.robot.recorder import DETECTOR, OPERATOR, Recorder
from lerobot_roborecover.robot.suggestions import FailureWatch

FROZEN_AFTER_S = 1.0
"""A camera that gives the same bytes for this long is frozen; its noise alone changes them otherwise."""


@dataclass
class RolloutEnd:
    """How a rollout on a robot ended. Apart from `TrialRow`: the verdict is a person's, and comes later."""

    steps: int = 0
    """Actions that were sent, a person's included."""
    duration_s: float = 0.0
    ended: str = "time"
    """`time`, `button` (a person ended it), `stop` (emergency), `policy` (it raised), or `trouble`."""
    button: str = ""
    """That ended it."""
    problem: str = ""
    """Of `trouble` and `policy`: one line."""
    episode: int | None = None
    interventions: list[dict[str, Any]] = field(default_factory=list)
    actions_sha256: str = ""
    marks: list[int] = field(default_factory=list)
    """Frames at which a person has marked that something went wrong."""
    suggested: int | None = None
    """Frame of the detector's first alarm."""
    clock_jump_s: float = 0.0


class RecordedRollout:
    """Runs a policy until time is up, a button is pressed, or something breaks; records every frame.

    The loop is that of LeRobot's strategies. Of LeRobot it takes the public parts alone (engine, processors,
    robot): what its strategies share among themselves changes between versions.

    Args:
        recorder: gets the frames.
        console: shows that the policy runs, and takes `end`, `mark`, `takeover`, `handback` and `stop`.
        limit_s: time limit.
        instruction: of the task.
        teleop: a connected LeRobot teleoperator for takeovers, or None.
        columns: values of the recorder's further columns.
        watch: a detector that suggests a moment, or None.
    """

    def __init__(
        self,
        recorder: Recorder,
        console: Console,
        limit_s: float,
        instruction: str,
        teleop: Any = None,
        columns: Mapping[str, Any] | None = None,
        watch: FailureWatch | None = None,
    ):
        self._engine: Any = None
        self._recorder, self._console, self._limit_s = recorder, console, limit_s
        self._instruction, self._teleop, self._columns = instruction, teleop, columns
        self._watch = watch
        self._same: dict[str, tuple[int, float]] = {}
        self.end = RolloutEnd()

    def setup(self, ctx: Any) -> None:
        """Gives the policy a fresh history and starts its engine."""
        self.end, self._same = RolloutEnd(), {}
        self._engine = ctx.policy.inference
        self._engine.reset()
        self._engine.start()

    def run(self, ctx: Any) -> None:
        """Runs the loop; `end` says how it ended. What was recorded is kept, whatever happens."""
        digest = hashlib.sha256()
        self._recorder.begin(self._columns)
        if self._watch is not None:
            self._watch.begin()
        try:
            self._loop(ctx, digest)
        except RobotLostError as err:
            self.end.ended, self.end.problem = "trouble", str(err)
        except Exception as err:  # a policy may raise anything; its trial becomes a row with the reason
            words = " ".join(str(err).split())[:300]
            self.end.ended, self.end.problem = "policy", f"the policy failed: {type(err).__name__}: {words}"
        finally:
            self.end.actions_sha256 = digest.hexdigest() if self.end.steps else ""
            self.end.episode = self._recorder.save()
        if self.end.episode is not None:
            for frame in self.end.marks:
                self._recorder.mark(self.end.episode, frame, OPERATOR)
            if self.end.suggested is not None:
                self._recorder.mark(self.end.episode, self.end.suggested, DETECTOR)

    def teardown(self, ctx: Any) -> None:
        """Stops the engine; the robot stays connected and where it is."""
        if self._engine is not None:
            self._engine.stop()

    def _loop(self, ctx: Any, digest: Any) -> None:
        robot, clock = ctx.hardware.robot_wrapper, clock_of(ctx.hardware.robot_wrapper.inner.held)
        interval = 1 / ctx.runtime.cfg.fps
        features, driving = ctx.data.dataset_features, False
        compiling = ctx.runtime.cfg.use_torch_compile
        horizon = round(self._limit_s * ctx.runtime.cfg.fps)
        start = clock.now()
        self._engine.resume()
        while True:
            tick = clock.now()
            self.end.duration_s = tick - start
            if self.end.steps >= horizon or self.end.duration_s >= self._limit_s:
                return
            self._console.update(left_s=max(self._limit_s - self.end.duration_s, 0.0))
            driving, over = self._heard(driving)
            if over:
                return
            if self._engine.failed:
                self.end.ended = "policy"
                self.end.problem = "the policy failed in its own thread (RTC); LeRobot's lines above say why"
                return
            observation = robot.get_observation()
            self._recorder.observed()
            self._console.show_live({c: observation[c] for c in camera_names(robot)})
            if problem := self._frozen(robot, observation, tick):
                self.end.ended, self.end.problem = "trouble", problem
                return
            processed = ctx.processors.robot_observation_processor(observation)
            self._engine.notify_observation(processed)
            if compiling:
                compiling = not self._engine.ready
                if not compiling:  # what it inferred while it compiled is stale
                    self._engine.reset()
                    self._engine.resume()
                clock.sleep(interval - (clock.now() - tick))
                continue
            acts = self._person_acts if driving else self._policy_acts
            action = acts(ctx, observation, processed)
            if action is not None:
                frame = {
                    **build_dataset_frame(features, processed, prefix=OBS_STR),
                    **build_dataset_frame(features, action, prefix=ACTION),
                }
                digest.update(np.asarray(frame[ACTION], np.float32).tobytes())
                if self._watch is not None and self._watch.alarms(frame, self._instruction):
                    self.end.suggested = len(self._recorder)
                    self._console.update(notice="The detector has an alarm: has something gone wrong?")
                self._recorder.add(frame, self._instruction, driving)
                self.end.steps += 1
                if driving:
                    self.end.interventions[-1]["steps"] += 1
            clock.sleep(interval - (clock.now() - tick))

    def _heard(self, driving: bool) -> tuple[bool, bool]:
        """Takes what people have pressed: who drives from now on, and whether the rollout is over."""
        if self._console.stopped:
            self.end.ended, self.end.button = "stop", "stop"
            return driving, True
        if self._console.phone_gone:
            self.end.ended = "trouble"
            self.end.problem = (
                "the phone does not answer any more, so its stop button would not work: the policy was "
                "ended. Bring the phone back, or press Leave on it and use the keyboard"
            )
            return driving, True
        answer = self._console.poll()
        if answer is None:
            return driving, False
        if answer.button == "mark":
            self.end.marks.append(len(self._recorder))
        elif answer.button == "takeover" and self._teleop is not None and not driving:
            self._engine.pause()
            entry = {"kind": "takeover", "step": self.end.steps, "by": "person", "steps": 0}
            self.end.interventions.append(entry)
            return True, False
        elif answer.button == "handback" and driving:
            # As in simulation, the policy goes on with fresh history.
            self._engine.reset()
            self._engine.resume()
            return False, False
        elif answer.button in ("end", "success", "failure"):
            self.end.ended, self.end.button = "button", answer.button
            return driving, True
        return driving, False

    def _policy_acts(
        self, ctx: Any, observation: dict[str, Any], processed: dict[str, Any]
    ) -> dict[str, Any] | None:
        """Sends the policy's next action and returns it; None where its thread has none yet."""
        frame = build_dataset_frame(ctx.data.dataset_features, processed, prefix=OBS_STR)
        values = self._engine.get_action(frame)
        if values is None:
            return None
        names = ctx.data.ordered_action_keys
        action = {name: value.item() for name, value in zip(names, values.cpu(), strict=True)}
        ctx.hardware.robot_wrapper.send_action(ctx.processors.robot_action_processor((action, observation)))
        return action

    def _person_acts(
        self, ctx: Any, observation: dict[str, Any], processed: dict[str, Any]
    ) -> dict[str, Any]:
        """Sends the teleoperator's action and returns it."""
        with asking(self._teleop):
            given = self._teleop.get_action()
        action = ctx.processors.teleop_action_processor((given, observation))
        ctx.hardware.robot_wrapper.send_action(ctx.processors.robot_action_processor((action, observation)))
        return action

    def _frozen(self, robot: Any, observation: dict[str, Any], now: float) -> str:
        """Says which camera has given the same picture for too long; empty where none has."""
        for camera in camera_names(robot):
            print_of = zlib.crc32(np.ascontiguousarray(observation[camera]))
            before, since = self._same.get(camera, (None, now))
            if print_of != before:
                self._same[camera] = (print_of, now)
            elif now - since >= FROZEN_AFTER_S:
                return (
                    f"camera {camera!r} has given the same picture for {now - since:.1f} s: it is frozen, "
                    "and the policy was ended. Plug the camera in again, then repeat the trial"
                )
        return ""
