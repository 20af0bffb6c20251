"""An annotator at the page: goes to frames, reads what stands there, marks and votes, with keys alone."""

from __future__ import annotations

import re
from typing import Any

from lerobot_roborecover.curation.annotation.annotators import Eye
from lerobot_roborecover.curation.annotation.guide import STAGES, TYPES
from lerobot_roborecover.curation.annotation.looking import Look, Sheet, frames_to_look_at
from lerobot_roborecover.curation.annotation.rules import Verdict, judge
from lerobot_roborecover.curation.annotation.votes import DISCARD_REASONS
from lerobot_roborecover.scenario import ScenarioError

WAIT_S = 120.0
"""Longest that a frame or an episode may take."""

_READ = """() => {
  const readout = document.querySelector("#readout"), rows = {};
  for (const o of readout.querySelectorAll("output"))
    (rows[o.dataset.of] ??= {})[o.dataset.value] = Number(o.textContent);
  return { step: Number(readout.dataset.step), rows };
}"""
_SHEET = """() => ({
  id: document.body.dataset.episode, instruction: document.querySelector("#instruction").textContent,
  about: document.querySelector("#about").textContent, frame: document.querySelector("#frame").textContent,
  time: document.querySelector("#time").textContent, human: !document.querySelector("#human").hidden,
  readout: Number(document.querySelector("#readout").dataset.step),
  shown: document.querySelector("#cameras canvas")?.dataset.episode ?? "",
  waiting: document.body.dataset.waiting, done: document.querySelector("#done").textContent,
  total: document.querySelector("#total").textContent,
  message: document.querySelector("#message").textContent,
})"""
_GUIDE_OPEN = "() => document.querySelector('#guide').open"
_AT = "([frame]) => Number(document.querySelector('#readout').dataset.step) === frame"
_SAVED = "() => [undefined, '0'].includes(document.body.dataset.waiting)"
_OPENED = """([after]) => {
  const id = document.body.dataset.episode;
  const shown = document.querySelector("#cameras canvas")?.dataset.episode;
  return id && id !== after && shown === id && !document.querySelector("#frame").textContent.includes("…");
}"""
_AT_END = """() => {
  const [at, last] = document.querySelector("#frame").textContent.split(" / ").map(Number);
  return at === last && Number(document.querySelector("#readout").dataset.step) === last;
}"""


class Annotator:
    """One annotator before the page.

    Args:
        page: a Playwright page at the annotator's address.
        eye: how it looks.
    """

    def __init__(self, page: Any, eye: Eye):
        self._page, self._eye, self._at = page, eye, 0

    def left(self) -> int:
        """Episodes without this annotator's vote."""
        said = self._page.evaluate(_SHEET)
        return int(said["total"]) - int(said["done"])

    def annotate(self, after: str = "") -> tuple[str, Verdict]:
        """Looks at the episode that the page shows, and votes.

        Args:
            after: the episode voted on before, which the page may still show.

        Returns:
            The candidate, and what was entered.

        Raises:
            ScenarioError: the page does not get on; what it says.
        """
        look = Look(self._opened(after))
        self._look_along(look)
        verdict = judge(look, self._eye)
        if verdict.step is not None:
            self._look_closer(look, verdict.step)
            verdict = judge(look, self._eye)
        self._enter(look, verdict)
        return look.sheet.candidate, verdict

    def saved(self) -> None:
        """Waits until the server has every vote on disk."""
        self._wait(_SAVED, "the last votes to be saved")

    def _opened(self, after: str) -> Sheet:
        self._wait(_OPENED, "the next episode", after)
        # A first visit opens the guide, and these visits are all first ones.
        if self._page.evaluate(_GUIDE_OPEN):
            self._press("g")
        self._press("End")
        self._wait(_AT_END, "its end")
        said = self._page.evaluate(_SHEET)
        last = int(said["frame"].split(" / ")[1])
        seconds = float(said["time"].split()[0])
        self._press("Home")
        self._at = 0
        self._read(0)
        fps = last / seconds if seconds else 1.0
        return Sheet(
            said["id"], said["instruction"], last, fps, "ends solved" in said["about"], said["human"]
        )

    def _look_along(self, look: Look) -> None:
        for frame in frames_to_look_at(self._eye.first_look, look.sheet.fps, look.sheet.last):
            self._go(frame)
            look.readings[frame] = self._read(frame)

    def _look_closer(self, look: Look, step: int) -> None:
        """Every frame from the look before the point up to it."""
        before = [f for f in look.frames() if f < step]
        for frame in range(step - 1, int(before[-1]) if before else 0, -1):
            self._go(frame)
            look.readings[frame] = self._read(frame)

    def _enter(self, look: Look, verdict: Verdict) -> None:
        if verdict.discard:
            self._discard(verdict.discard)
            return
        assert verdict.step is not None
        assert verdict.stage is not None
        assert verdict.deviation is not None
        # The guide: before the first action nothing was done.
        self._go(max(verdict.step, 1))
        self._press("r")
        said = self._page.evaluate(_SHEET)["message"]
        if "at the earliest" in said:
            self._go(int(re.findall(r"\d+", said)[0]))
            self._press("r")
        self._press(STAGES[verdict.stage][0])
        self._press(TYPES[verdict.deviation][0])
        self._press("Enter")

    def _discard(self, reason: str) -> None:
        if reason == "temporary":
            self._press("t")
            return
        self._press("d")
        self._page.wait_for_selector("#reasons[open]")
        self._press(str(list(DISCARD_REASONS).index(reason) + 1))

    def _go(self, frame: int) -> None:
        """Goes to a frame, by tens and ones."""
        by = frame - self._at
        key = "ArrowRight" if by > 0 else "ArrowLeft"
        for keys, count in ((f"Shift+{key}", abs(by) // 10), (key, abs(by) % 10)):
            for _ in range(count):
                self._press(keys)
        self._at = frame
        self._read(frame)

    def _read(self, frame: int) -> dict[str, dict[str, float]]:
        said = self._page.evaluate(_READ)
        if said["step"] != frame:
            self._wait(_AT, f"frame {frame}", frame)
            said = self._page.evaluate(_READ)
        return said["rows"]

    def _wait(self, wanted: str, what: str, *values: Any) -> None:
        """Until a condition on the page holds."""
        from playwright.sync_api import TimeoutError as WaitedInVain

        try:
            self._page.wait_for_function(wanted, arg=list(values), timeout=1000 * WAIT_S)
        except WaitedInVain:
            said = self._page.evaluate(_SHEET)
            raise ScenarioError(
                f"waited {WAIT_S:g} s for {what}; the page is at frame {said['readout']} of {said['id']!r} "
                f"and says {said['message']!r}"
            ) from None

    def _press(self, key: str) -> None:
        self._page.keyboard.press(key)
