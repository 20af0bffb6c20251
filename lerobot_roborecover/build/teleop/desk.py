"""The thread that owns the simulator: takes commands and held inputs in turn, steps, and shows what it sees.

Rendering never decides how fast the robot moves: pictures are made only when somebody waits for one, and take
at most half of the time; steps that came due meanwhile are made up for.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lerobot_roborecover.build.teleop.controls import AXES
from lerobot_roborecover.build.teleop.hub import Hub
from lerobot_roborecover.build.teleop.pilot import Command, Pilot, Tick
from lerobot_roborecover.build.teleop.protocol import (
    MAX_ACTIONS,
    MAX_BACK,
    plain_text,
    whole_number,
)
from lerobot_roborecover.build.teleop.session import Session
from lerobot_roborecover.build.teleop.starts import StartPoint, first_state
from lerobot_roborecover.build.teleop.store import Store
from lerobot_roborecover.datasets.frames import camera_pictures
from lerobot_roborecover.scenario import Pose, ScenarioError
from lerobot_roborecover.simulators.base import Simulator, SimulatorError

_LOG = logging.getLogger(__name__)
_IDLE_S = 0.5
JPEG_QUALITY = 80


class Desk(threading.Thread):
    """One operator's simulator.

    Args:
        make_simulator: called in this thread, which alone uses what it returns.
        operator: who drives.
        starts: where to begin, in order.
        store: takes what is saved.
        hub: whoever looks on.
        rate_hz: control steps a second, at most; None for the simulator's own.
        fps: pictures a second, at most.
    """

    def __init__(
        self,
        make_simulator: Callable[[], Simulator],
        operator: str,
        starts: Sequence[StartPoint],
        store: Store,
        hub: Hub,
        rate_hz: float | None = None,
        fps: float = 15.0,
    ):
        super().__init__(name="teleop", daemon=True)
        self._make, self._operator, self._starts = make_simulator, operator, starts
        self._store, self._hub, self._fps = store, hub, fps
        self._rate_hz = rate_hz
        self._stopped = threading.Event()
        self.ready = threading.Event()
        self.error: Exception | None = None
        """Why the simulator cannot be had."""
        self.pilot = Pilot(1.0, 1.0)
        self._number = store.next_number()
        self._saved = len(store.paths())
        self._at: int | None = None
        """Of the start under way, in the list."""
        self._shown_step = -1
        self._look_at = 0.0
        self._broken = ""

    def run(self) -> None:
        """Until `stop`."""
        try:
            simulator = self._make()
            self._session = Session(simulator, self._operator)
        except Exception as err:  # whatever a simulator's import or driver raises is told to whoever waits
            self.error = err
            self.ready.set()
            return
        rate = min(self._rate_hz or simulator.control_hz, simulator.control_hz)
        self.pilot.rate_hz, self.pilot.control_hz = rate, simulator.control_hz
        self._hub.publish(self._status())
        self.ready.set()
        try:
            while not self._stopped.is_set():
                self._turn()
        finally:
            simulator.close()

    def stop(self) -> None:
        """Ends the thread after what it is doing."""
        self._stopped.set()
        self.pilot.command(Command("status", {}, lambda _answer: None))

    # --- one turn

    def _turn(self) -> None:
        wait_s = _IDLE_S
        if self._shown_step != self._session.step and self._hub.wants_pictures():
            wait_s = max(0.0, min(_IDLE_S, self._look_at - time.monotonic()))
        event = self.pilot.poll(wait_s, drive=self._session.start_point is not None)
        if isinstance(event, Command):
            self._answer(event)
        elif isinstance(event, Tick):
            self._step(event)
        if self._hub.wants_pictures() and time.monotonic() >= self._look_at:
            self._show()

    def _step(self, tick: Tick) -> None:
        try:
            self._session.act(self._session.controls.action(tick.axes, tick.closed), tick.device)
        except Exception as err:  # a simulator may raise whatever it likes; the page goes on
            self.pilot.let_go()
            self._fail(err)
        self._hub.publish(self._status())

    def _fail(self, err: Exception) -> str:
        if not isinstance(err, ScenarioError):
            _LOG.exception("the simulator broke")
            # Its state is unknown: nothing of it may be saved.
            self._session.start_point = self._session._trail = None
            self._at = None
        self._broken = str(err) or type(err).__name__
        return self._broken

    def _answer(self, command: Command) -> None:
        self._broken = ""
        try:
            said = getattr(self, f"_do_{command.kind}")(command.values) or {}
            command.reply({"ok": True, **said, "status": self._status()})
        except (ScenarioError, SimulatorError) as err:
            broken = isinstance(err, SimulatorError)
            message = self._fail(err) if broken else str(err)
            command.reply({"ok": False, "message": message, "status": self._status()})
        except Exception as err:  # as above
            command.reply({"ok": False, "message": self._fail(err), "status": self._status()})
        self._hub.publish(self._status())

    def _show(self) -> None:
        if self._session.start_point is None or self._shown_step == self._session.step:
            return
        began = time.monotonic()
        try:
            pictures = camera_pictures(self._session.simulator.platform, self._session.simulator.observe())
        except Exception as err:  # no OpenGL, or a broken context: driving by numbers still works
            self._fail(err if isinstance(err, ScenarioError) else ScenarioError(f"no picture: {err}"))
            pictures = {}
        self._shown_step = self._session.step
        self._hub.show(self._shown_step, {n: encode(p) for n, p in pictures.items()})
        ended = time.monotonic()
        self._look_at = max(began + 1 / self._fps, ended + (ended - began))

    # --- commands

    def _do_status(self, sent: dict[str, Any]) -> dict[str, Any] | None:
        return self._state() if sent.get("state") else None

    def _do_start(self, sent: dict[str, Any]) -> dict[str, Any] | None:
        if "task" in sent:
            seed = whole_number(sent, "seed", 0, 2**32 - 1) if "seed" in sent else None
            state = whole_number(sent, "init_state", 0, 2**32 - 1) if "init_state" in sent else None
            platform = self._session.simulator.platform
            start = first_state(platform, plain_text(sent, "task"), plain_text(sent, "suite"), seed, state)
            number = None
        else:
            if not self._starts:
                raise ScenarioError("this session lists no starts; name a task, or give --task or --continue")
            number = whole_number(sent, "number", 0, len(self._starts) - 1)
            start = self._starts[number]
        self._guard_unsaved(sent)
        self._at = None
        self._session.start(start)
        self._at = number
        self._shown_step = -1
        self.pilot.let_go()
        last = start.prefix[-1] if len(start.prefix) else None
        self.pilot.closed = last is not None and self._session.controls.closed_by(last)
        return self._state() if sent.get("state") else None

    def _guard_unsaved(self, sent: dict[str, Any]) -> None:
        start = self._session.start_point
        if start is not None and self._session.step > len(start.prefix) and not sent.get("discard"):
            raise ScenarioError("a recording is under way; save or discard it first")

    def _do_act(self, sent: dict[str, Any]) -> dict[str, Any] | None:
        actions = sent.get("actions")
        if not isinstance(actions, list) or not 1 <= len(actions) <= MAX_ACTIONS:
            raise ScenarioError(f"actions must be a list of 1 to {MAX_ACTIONS} actions")
        checked = [self._session.controls.check(a) for a in actions]
        for action in checked:
            self._session.act(action, "script")
        self.pilot.closed = self._session.controls.closed_by(checked[-1])
        return self._state() if sent.get("state") else None

    def _do_back(self, sent: dict[str, Any]) -> dict[str, Any]:
        self.pilot.let_go()
        taken = self._session.back(whole_number(sent, "steps", 1, MAX_BACK))
        start = self._session.start_point
        if start is not None and self._session.actions:
            self.pilot.closed = self._session.controls.closed_by(self._session.actions[-1])
        self._shown_step = -1
        return {"taken_back": taken}

    def _do_mark(self, sent: dict[str, Any]) -> None:
        self._session.set_mark(plain_text(sent, "stage"), plain_text(sent, "deviation"))

    def _do_relabel(self, sent: dict[str, Any]) -> None:
        self._session.relabel(plain_text(sent, "stage"), plain_text(sent, "deviation"))

    def _do_unmark(self, _sent: dict[str, Any]) -> None:
        self._session.mark = None

    def _do_gripper(self, _sent: dict[str, Any]) -> None:
        if self._session.controls.gripper is None:
            raise ScenarioError(f"{self._session.simulator.platform} has no gripper")
        self.pilot.toggle_gripper()

    def _do_realtime(self, sent: dict[str, Any]) -> None:
        self.pilot.realtime = bool(sent.get("on"))

    def _do_finish(self, sent: dict[str, Any]) -> dict[str, Any]:
        start = self._session.start_point
        if start is None:
            raise ScenarioError("nothing is under way; start a task first")
        place = f"i{start.reset.init_state_index}" if start.reset.init_state_index is not None else ""
        place += f"s{start.reset.seed}"
        task = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "-" for c in start.task.name)
        # The name's length is bounded, whatever the task's is.
        identity = f"{self._operator}-{task[:60]}-{place}-{self._number:06d}"
        recorded = self._session.recorded(identity, bool(sent.get("as_dropped")))
        self._store.add(recorded, self._number)
        self._number, self._saved = self._number + 1, self._saved + 1
        self._end()
        return {"saved": identity, "dropped": recorded.lacks}

    def _do_discard(self, _sent: dict[str, Any]) -> None:
        self._end()

    def _do_hand_back(self, _sent: dict[str, Any]) -> None:
        raise ScenarioError("nobody waits for this simulator; finish or discard the recording")

    def _end(self) -> None:
        self._session.start_point = self._session._trail = None
        self.pilot.let_go()

    # --- what is told

    def _status(self) -> dict[str, Any]:
        session = self._session
        start = session.start_point
        status: dict[str, Any] = {
            "type": "status",
            "mode": "record",
            "operator": self._operator,
            "platform": session.simulator.platform,
            "axes": [a for a in AXES if a in session.controls.columns],
            "gripper": session.controls.gripper is not None,
            "closed": self.pilot.closed,
            "realtime": self.pilot.realtime,
            "rate_hz": self.pilot.rate_hz,
            "starts": len(self._starts),
            "number": self._at,
            "saved": self._saved,
            "problem": self._broken,
            "under_way": start is not None,
        }
        if start is None:
            return status
        mark = session.mark
        eef = next((p for n, p in session.bodies[-1].items() if n.startswith("eef")), None)
        return {
            **status,
            "instruction": start.task.instruction,
            "label": start.label,
            "step": session.step,
            "first_step": len(start.prefix),
            "horizon": start.task.horizon,
            "solved": session.solved[-1],
            "mark": None if mark is None else [mark.step, mark.stage, mark.deviation],
            "proven": session.proven,
            "lacks": session.lacks(),
            "eef_m": None if eef is None else [round(v, 5) for v in eef.position_m],
        }

    def _state(self) -> dict[str, Any]:
        """Everything that a script may want to see, exactly."""
        session = self._session
        low_dim = getattr(session.simulator, "low_dim", None)
        return {
            "bodies": {n: _list(p) for n, p in session.bodies[-1].items()} if session.bodies else {},
            "low_dim": None if low_dim is None else np.asarray(low_dim()).tolist(),
        }


def encode(picture: np.ndarray) -> bytes:
    """A (H, W, 3) uint8 picture as JPEG."""
    import cv2

    good, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    )
    if not good:
        raise SimulatorError(f"a picture of shape {picture.shape} cannot be encoded")
    return data.tobytes()


def _list(pose: Pose) -> list[float]:
    return [*pose.position_m, *pose.quat_xyzw]
