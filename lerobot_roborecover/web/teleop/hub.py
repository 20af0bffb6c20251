"""Connects the viewers of a simulator to its thread: one viewer drives, the others watch.

A viewer gets new images only once it has shown the last ones, so that no images queue up in a slow tunnel. It
gets only the latest status.
"""

from __future__ import annotations

import asyncio
import json
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any

from lerobot_roborecover.web.teleop.protocol import picture

MAX_VIEWERS = 8
MAX_REPLIES = 1024
"""Answers that wait for a viewer which does not read them."""


class Viewer:
    """One connection; used in the server's thread."""

    def __init__(self, pictures: bool):
        self.pictures = pictures
        self.seen = True
        """It has shown the last pictures."""
        self.replies: deque[str] = deque(maxlen=MAX_REPLIES)
        self.status_due = True
        self.pictures_due = True
        self.cameras: list[str] = []
        self.sent_at = 0
        """Steps taken, over the session, when the pictures that it was sent were made."""
        self.shown_at: int | None = None
        """Likewise of those that it has shown; None before the first."""
        self.wake = asyncio.Event()


class Hub:
    """Viewers of one simulator; `publish`, `show` and `wants_pictures` are for its thread."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self.viewers: list[Viewer] = []
        self.driver: Viewer | None = None
        self._status: dict[str, Any] = {"type": "status", "under_way": False, "step": -1}
        self._frames: tuple[int, dict[str, bytes], int, int] | None = None
        self._wanted = threading.Event()

    # --- the simulator's thread

    def publish(self, status: dict[str, Any]) -> None:
        self._call(self._take_status, status)

    def show(self, step: int, frames: Mapping[str, bytes], taken: int = 0, scene: int = 0) -> None:
        """Takes the latest pictures.

        Args:
            step: of the recording.
            frames: JPEG by camera.
            taken: steps over the whole session; see `unseen`.
            scene: counts the starts that were loaded; so that a page does not take the last one's picture for
                that of the one before it.
        """
        self._wanted.clear()
        self._call(self._take_frames, step, dict(frames), taken, scene)

    def wants_pictures(self) -> bool:
        """Whether a viewer waits for images."""
        return self._wanted.is_set()

    def watched(self) -> bool:
        """Whether any viewer receives images."""
        return any(v.pictures for v in list(self.viewers))

    def unseen(self, taken: int) -> int:
        """Returns how many steps the controller has not seen yet; 0 for a controller that receives no images.

        Args:
            taken: steps over the whole session.
        """
        driver = self.driver
        if driver is None or not driver.pictures or driver.shown_at is None:
            return 0
        return taken - driver.shown_at

    def _call(self, function: Any, *args: Any) -> None:
        loop = self._loop
        if loop is None:
            function(*args)
            return
        try:
            loop.call_soon_threadsafe(function, *args)
        except RuntimeError:  # the server has ended
            return

    # --- the server's

    def join(self, pictures: bool) -> Viewer | None:
        """Adds a viewer, which drives if there is no controller. None where there are too many viewers."""
        self._loop = asyncio.get_running_loop()
        if len(self.viewers) >= MAX_VIEWERS:
            return None
        viewer = Viewer(pictures)
        self.viewers.append(viewer)
        if self.driver is None:
            self.drive(viewer)
        self._ask()
        # One that only watches has news, too: where things stand, and the latest pictures.
        viewer.wake.set()
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """A viewer is gone; another one may drive when it asks to."""
        self.viewers.remove(viewer)
        if self.driver is viewer:
            self.driver = None
            self._everybody()

    def drive(self, viewer: Viewer) -> None:
        """Makes a viewer the controller."""
        self.driver = viewer
        self._everybody()

    def seen(self, viewer: Viewer) -> None:
        """A viewer has shown what it got."""
        viewer.seen, viewer.shown_at = True, viewer.sent_at
        self._ask()
        if viewer.pictures_due:
            viewer.wake.set()

    def next_messages(self, viewer: Viewer) -> list[str | bytes]:
        """What a viewer should be sent now."""
        messages: list[str | bytes] = []
        while viewer.replies:
            messages.append(viewer.replies.popleft())
        if viewer.status_due:
            viewer.status_due = False
            role = "drive" if self.driver is viewer else "watch"
            told = {**self._status, "role": role, "driven": self.driver is not None}
            messages.append(json.dumps({**told, "viewers": len(self.viewers)}))
        if viewer.pictures and viewer.pictures_due and viewer.seen and self._frames is not None:
            viewer.pictures_due = viewer.seen = False
            step, frames, viewer.sent_at, scene = self._frames
            if list(frames) != viewer.cameras:
                viewer.cameras = list(frames)
                messages.append(json.dumps({"type": "cameras", "names": viewer.cameras}))
            messages += [picture(i, step, data) for i, data in enumerate(frames.values())]
            messages.append(json.dumps({"type": "shown", "step": step, "scene": scene}))
        return messages

    def _take_status(self, status: dict[str, Any]) -> None:
        self._status = status
        self._everybody()

    def _take_frames(self, step: int, frames: dict[str, bytes], taken: int, scene: int) -> None:
        self._frames = (step, frames, taken, scene)
        for viewer in self.viewers:
            viewer.pictures_due = True
            viewer.wake.set()

    def _everybody(self) -> None:
        for viewer in self.viewers:
            viewer.status_due = True
            viewer.wake.set()

    def _ask(self) -> None:
        if any(v.pictures and v.seen for v in self.viewers):
            self._wanted.set()
