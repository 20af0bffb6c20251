"""The thread that owns the simulator: processes commands and held inputs, steps, and renders images.

Where images are slow to render or to send, the robot waits for them: between two images it moves no further
than in real time. Images are rendered only when a viewer waits for one.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from lerobot_roborecover.datasets.frames import camera_pictures
from lerobot_roborecover.platforms.simulator import Simulator, SimulatorError
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.web.teleop.hub import Hub
from lerobot_roborecover.web.teleop.pilot import (
    InputHandler,
    OperatorCommand,
    Tick,
    most_unseen,
    steps_per_picture,
)
from lerobot_roborecover.web.teleop.protocol import (
    MAX_ACTIONS,
    MAX_BACK,
    plain_text,
    whole_number,
)
from lerobot_roborecover.web.teleop.session import TeleopSession
from lerobot_roborecover.web.teleop.starts import StartPoint, first_state, next_open
from lerobot_roborecover.web.teleop.status import encode, exact_state, of_session
from lerobot_roborecover.web.teleop.store import Store, read_recording

_LOG = logging.getLogger(__name__)
_IDLE_S = 0.5
_SOON_S = 0.01
"""Longest time that a requested image waits for the commands before it, seconds."""
_TOLD_EVERY_S = 0.5


_IN_PREVIEWS = ("start", "preview", "status", "discard", "realtime", "hand_back")


class SimulatorThread(threading.Thread):
    """One operator's simulator.

    Args:
        make_simulator: called in this thread, which alone uses what it returns.
        operator: name.
        starts: where to begin, in order.
        store: takes what is saved.
        hub: the viewers.
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
        self.pilot = InputHandler(1.0, 1.0)
        self._number = store.next_number()
        self._saved = len(store.paths())
        self._at: int | None = None
        """Of the start under way or shown, in the list."""
        self._next = next_open(starts, map(read_recording, store.paths()))
        """Of the start that comes next."""
        self._previewing = False
        """The start is loaded and shown, and driving has not begun yet."""
        self._unloadable: int | None = None
        """The start that could not be shown; it is not tried again by itself."""
        self._loading: dict[str, Any] | None = None
        self._taken = self._pictured = 0
        """Steps over the session."""
        self._scene = 0
        """Starts loaded over the session."""
        self._shown_step = -1
        self._look_at = 0.0
        self._broken = ""

    def run(self) -> None:
        try:
            simulator = self._make()
            self._session = TeleopSession(simulator, self._operator)
        except Exception as err:  # an import or driver may raise anything; the main thread reports it
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
        """Ends the thread after its current command."""
        self._stopped.set()
        self.pilot.command(OperatorCommand("status", {}, lambda _answer: None))

    # --- one turn

    def _turn(self) -> None:
        paused = self._hub.unseen(self._taken) >= most_unseen(self.pilot.rate_hz, self._fps)
        event = self.pilot.poll(self._wait_s(paused), drive=self._driving, paused=paused)
        if isinstance(event, OperatorCommand):
            self._answer(event)
        elif isinstance(event, Tick):
            self._step(event)
        elif self._owes_preview():
            self._preview()
        # Steps that are due already come first, as many as belong between two pictures.
        few = self._taken - self._pictured < steps_per_picture(self.pilot.rate_hz, self._fps)
        if self._picture_due() and not (isinstance(event, Tick) and few):
            self._show()

    def _picture_due(self) -> bool:
        return self._hub.wants_pictures() and time.monotonic() >= self._look_at

    @property
    def _driving(self) -> bool:
        return self._session.start_point is not None and not self._previewing

    def _wait_s(self, paused: bool) -> float:
        """How long to wait for a command or a step."""
        if self._owes_preview():
            return 0.0
        stale = self._session.start_point is not None and self._shown_step != self._session.step
        if stale and self._picture_due():
            return 0.0
        if paused or (stale and self._hub.watched()):
            return min(_IDLE_S, max(self._look_at - time.monotonic(), _SOON_S))
        return _IDLE_S

    def _owes_preview(self) -> bool:
        """Whether a viewer receives images and there is a start to show."""
        idle = self._session.start_point is None and self._next is not None
        return idle and self._next != self._unloadable and self._hub.watched()

    def _preview(self) -> None:
        number = self._next
        assert number is not None
        try:
            self._load(self._starts[number], number)
            self._previewing = True
        except Exception as err:  # as below
            self._unloadable = number
            self._fail(err)
        self._hub.publish(self._status())

    def _load(self, start: StartPoint, number: int | None) -> None:
        """Puts the simulator at a start; says so first, since it takes seconds."""
        said = 0.0

        def told(done: int, of: int) -> None:
            nonlocal said
            if time.monotonic() - said < _TOLD_EVERY_S:
                return
            self._loading = {
                "label": start.label,
                "instruction": start.task.instruction,
                "replayed": [done, of],
            }
            self._hub.publish(self._status())
            said = time.monotonic()
            time.sleep(0.02)  # the server's thread says it before a compiler takes the interpreter

        self._at, self._previewing = number, False
        self._session.start_point = self._session._history = None
        try:
            told(0, len(start.prefix))
            self._session.start(start, told)
        finally:
            self._loading = None
        self._shown_step, self._scene = -1, self._scene + 1
        self.pilot.let_go()
        last = start.prefix[-1] if len(start.prefix) else None
        self.pilot.closed = last is not None and self._session.controls.closed_by(last)

    def _step(self, tick: Tick) -> None:
        self._taken += 1
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
            self._session.start_point = self._session._history = self._at = None
            self._previewing = False
        self._broken = str(err) or type(err).__name__
        return self._broken

    def _answer(self, command: OperatorCommand) -> None:
        self._broken = ""
        try:
            if self._previewing and command.kind not in _IN_PREVIEWS:
                raise ScenarioError("this start is only shown yet; begin with Enter (`start`)")
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
        self._look_at = time.monotonic() + 1 / self._fps
        try:
            pictures = camera_pictures(self._session.simulator.platform, self._session.simulator.observe())
        except Exception as err:  # no OpenGL, or a broken context: driving by numbers still works
            self._fail(err if isinstance(err, ScenarioError) else ScenarioError(f"no picture: {err}"))
            pictures = {}
        self._shown_step, self._pictured = self._session.step, self._taken
        jpegs = {n: encode(p) for n, p in pictures.items()}
        self._hub.show(self._shown_step, jpegs, self._taken, self._scene)

    # --- commands

    def _do_status(self, sent: dict[str, Any]) -> dict[str, Any] | None:
        return exact_state(self._session) if sent.get("state") else None

    def _do_start(self, sent: dict[str, Any]) -> dict[str, Any] | None:
        if "task" in sent:
            seed = whole_number(sent, "seed", 0, 2**32 - 1) if "seed" in sent else None
            state = whole_number(sent, "init_state", 0, 2**32 - 1) if "init_state" in sent else None
            platform = self._session.simulator.platform
            start = first_state(platform, plain_text(sent, "task"), plain_text(sent, "suite"), seed, state)
            number = None
        else:
            number = self._numbered(sent)
            start = self._starts[number]
        self._guard_unsaved(sent)
        if number is not None:
            self._next = number
        # What is shown already is where it should be.
        if not (self._previewing and number is not None and number == self._at):
            self._load(start, number)
        self._previewing = False
        return exact_state(self._session) if sent.get("state") else None

    def _do_preview(self, sent: dict[str, Any]) -> None:
        number = self._numbered(sent)
        self._guard_unsaved(sent)
        if not (self._previewing and number == self._at):
            self._end()
        self._next, self._unloadable = number, None

    def _numbered(self, sent: dict[str, Any]) -> int:
        if not self._starts:
            raise ScenarioError("this session lists no starts; name a task, or give --task or --continue")
        return whole_number(sent, "number", 0, len(self._starts) - 1)

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
            self._taken += 1
            self._session.act(action, "script")
        self.pilot.closed = self._session.controls.closed_by(checked[-1])
        return exact_state(self._session) if sent.get("state") else None

    def _do_back(self, sent: dict[str, Any]) -> dict[str, Any]:
        self.pilot.let_go()
        taken = self._session.roll_back(whole_number(sent, "steps", 1, MAX_BACK))
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
        if self._at is not None:
            self._next = self._at + 1 if self._at + 1 < len(self._starts) else None
        self._end()
        return {"saved": identity, "dropped": recorded.lacks}

    def _do_discard(self, _sent: dict[str, Any]) -> None:
        if not self._previewing:
            self._end()

    def _do_hand_back(self, _sent: dict[str, Any]) -> None:
        raise ScenarioError("no trial waits for this simulator; finish or discard the recording")

    def _end(self) -> None:
        """Nothing is under way any more; a start that was discarded comes next once more."""
        self._session.start_point = self._session._history = None
        self._at, self._previewing = None, False
        self.pilot.let_go()

    # --- what is told

    def _status(self) -> dict[str, Any]:
        start = self._session.start_point
        phase = "preview" if self._previewing else "idle" if start is None else "driving"
        return {
            "type": "status",
            "mode": "record",
            "phase": "loading" if self._loading else phase,
            "operator": self._operator,
            "closed": self.pilot.closed,
            "realtime": self.pilot.realtime,
            "rate_hz": self.pilot.rate_hz,
            "starts": len(self._starts),
            "number": self._next if self._at is None else self._at,
            "scene": self._scene,
            "saved": self._saved,
            "problem": self._broken,
            "under_way": self._driving,
            **of_session(self._session),
            **(self._loading or {}),
        }
