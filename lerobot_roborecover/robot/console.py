"""What a person at the robot is asked, and answers, on a phone, a keyboard, or as a simulated operator."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

SETTLE_S = 0.7
"""A key that is pressed sooner after a new screen was meant for the one before."""
PHONE_GONE_S = 8.0
"""A phone that has not asked for this long is gone."""


@dataclass(frozen=True)
class Answer:
    """What a person has said."""

    button: str
    """Name of the button."""
    values: dict[str, str] = field(default_factory=dict)
    """Texts that were entered: a reason, a note."""


class Operator(Protocol):
    """Answers instead of a person; asked in the run's own thread."""

    def answer(self, screen: str, details: dict[str, Any]) -> Answer | None:
        """What is said to a screen; None leaves it to people."""


class Console:
    """The screen that people see, and what they have pressed.

    Args:
        operator: answers before people are asked.
        seconds: a monotonic clock, for tests.
    """

    def __init__(self, operator: Operator | None = None, seconds: Callable[[], float] = time.monotonic):
        self._operator, self._seconds = operator, seconds
        self._lock = threading.Condition()
        self._answers: deque[Answer] = deque()
        self._stop = threading.Event()
        self._screen: dict[str, Any] = {"name": "starting", "text": "", "buttons": [], "details": {}}
        self._version, self._shown_at = 0, float("-inf")
        self._heard: float | None = None
        self.pictures: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        """Recorded and live picture by camera, of the present screen."""

    # --- the run's side

    def show(
        self, name: str, text: str = "", buttons: Sequence[str] = (), details: dict[str, Any] | None = None
    ) -> None:
        """Shows a screen; answers to the one before and its pictures are forgotten, a stop is not."""
        with self._lock:
            self._screen = {
                "name": name,
                "text": text,
                "buttons": list(buttons),
                "details": details or {},
            }
            self._version, self._shown_at = self._version + 1, self._seconds()
            self._answers.clear()
            self.pictures = {}
            self._lock.notify_all()

    def ask(
        self,
        name: str,
        text: str,
        buttons: Sequence[str],
        details: dict[str, Any] | None = None,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> Answer:
        """Shows a screen and waits until one of its buttons is pressed.

        Args:
            name: of the screen.
            text: the question.
            buttons: names of those that may be pressed.
            details: further values for the page.
            meanwhile: called again and again while nothing is pressed, e.g. to renew live pictures.
        """
        self.show(name, text, buttons, details)
        if self._operator is not None:
            found = self._operator.answer(name, details or {})
            if found is not None:
                return found
        while True:
            meanwhile()
            with self._lock:
                if not self._answers:
                    self._lock.wait(0.2)
                if self._answers:
                    return self._answers.popleft()

    def show_live(self, pictures: Mapping[str, np.ndarray]) -> None:
        """Shows pictures by camera that have no recorded ones beside them."""
        self.pictures = {camera: (picture, picture) for camera, picture in pictures.items()}

    def update(self, **details: Any) -> None:
        """Renews values of the present screen."""
        with self._lock:
            self._screen["details"] = {**self._screen["details"], **details}

    def poll(self) -> Answer | None:
        """The next button that was pressed, without waiting."""
        if self._operator is not None:
            found = self._operator.answer(self._screen["name"], self._screen["details"])
            if found is not None:
                return found
        with self._lock:
            return self._answers.popleft() if self._answers else None

    @property
    def stopped(self) -> bool:
        """Whether the emergency stop was pressed and not released."""
        return self._stop.is_set()

    def release(self) -> None:
        """Takes the stop back, once a person has looked at the robot."""
        self._stop.clear()

    @property
    def phone_in(self) -> bool:
        """Whether a phone is there."""
        return self._heard is not None and not self.phone_gone

    @property
    def phone_gone(self) -> bool:
        """Whether a phone was there and does not ask any more."""
        return self._heard is not None and self._seconds() - self._heard > PHONE_GONE_S

    # --- the people's side

    def heard(self) -> None:
        """A phone has asked."""
        self._heard = self._seconds()

    def leave(self) -> None:
        """The phone has said that it goes."""
        self._heard = None

    def press_key(self, button: str) -> bool:
        """Takes a button from a keyboard, whose user may be looking at the robot; `stop` always works."""
        if button != "stop" and self._seconds() - self._shown_at < SETTLE_S:
            return False
        return self.press(button)

    def press(self, button: str, values: dict[str, str] | None = None, version: int | None = None) -> bool:
        """Takes a button; `stop` always works.

        Args:
            button: its name.
            values: texts beside it.
            version: of the screen that was pressed on; None takes the present one.

        Returns:
            False where the present screen is another one, or has no such button.
        """
        if button == "stop":
            self._stop.set()
        with self._lock:
            present = version is None or version == self._version
            known = button == "stop" or (present and button in self._screen["buttons"])
            if known and button in self._screen["buttons"]:
                self._answers.append(Answer(button, dict(values or {})))
                self._lock.notify_all()
            return known

    def state(self) -> dict[str, Any]:
        """The screen as a page takes it."""
        with self._lock:
            return {
                **self._screen,
                "version": self._version,
                "stopped": self.stopped,
                "cameras": list(self.pictures),
            }
