"""An automatic annotator at the real page, with its keys alone: it goes to frames, reads what stands there,
marks and votes. What the page shows has to lead to the votes that the recorded steps lead to."""

from __future__ import annotations

import re
from typing import Any

from lerobot_roborecover.curation.annotation.annotators import LabelerThresholds
from lerobot_roborecover.curation.annotation.automatic import verdict_on
from lerobot_roborecover.curation.annotation.features import EpisodeFeatures, EpisodeInfo, Reading
from lerobot_roborecover.curation.annotation.guide import STAGES, TYPES
from lerobot_roborecover.curation.annotation.rules import Verdict
from lerobot_roborecover.curation.annotation.votes import DISCARD_REASONS

READ = """() => {
  const readout = document.querySelector("#readout"), rows = {};
  for (const o of readout.querySelectorAll("output"))
    (rows[o.dataset.of] ??= {})[o.dataset.value] = Number(o.textContent);
  return { step: Number(readout.dataset.step), rows };
}"""
"""The readout's numbers, by row and value."""
_SHEET = """() => ({
  id: document.body.dataset.episode, instruction: document.querySelector("#instruction").textContent,
  about: document.querySelector("#about").textContent, frame: document.querySelector("#frame").textContent,
  time: document.querySelector("#time").textContent, human: !document.querySelector("#human").hidden,
  done: document.querySelector("#done").textContent, total: document.querySelector("#total").textContent,
  message: document.querySelector("#message").textContent,
})"""
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


class PageAnnotator:
    """One annotator before the page; the guide is closed.

    Args:
        page: a Playwright page at the annotator's address.
        eye: how it looks.
    """

    def __init__(self, page: Any, eye: LabelerThresholds):
        self._page, self._eye, self._at = page, eye, 0
        self.looks: list[EpisodeFeatures] = []
        """What it has read, by episode; these go by the page's names."""

    def annotate_all(self) -> None:
        """Votes on all that has no vote; every vote is on disk when this returns."""
        before = ""
        self._wait(_OPENED, before)
        said = self._page.evaluate(_SHEET)
        for _ in range(int(said["total"]) - int(said["done"])):
            sheet = self._opened(before)
            self.looks.append(EpisodeFeatures(sheet))
            self._enter(verdict_on(sheet, self._read, self._eye))
            before = sheet.candidate
        self._wait(_SAVED)

    def _opened(self, before: str) -> EpisodeInfo:
        self._wait(_OPENED, before)
        self._press("End")
        self._wait(_AT_END)
        said = self._page.evaluate(_SHEET)
        last, seconds = int(said["frame"].split(" / ")[1]), float(said["time"].split()[0])
        self._press("Home")
        self._at = 0
        solved = "ends solved" in said["about"]
        fps = last / seconds if seconds else 1.0
        return EpisodeInfo(said["id"], said["instruction"], last, fps, solved, said["human"])

    def _enter(self, verdict: Verdict) -> None:
        if verdict.discard == "temporary":
            self._press("t")
        elif verdict.discard:
            self._press("d")
            self._page.wait_for_selector("#reasons[open]")
            self._press(str(list(DISCARD_REASONS).index(verdict.discard) + 1))
        else:
            assert verdict.step is not None
            assert verdict.stage is not None
            assert verdict.deviation is not None
            # The guide: before the first action nothing was done.
            self._read(max(verdict.step, 1))
            self._press("r")
            said = self._page.evaluate(_SHEET)["message"]
            if "at the earliest" in said:
                self._read(int(re.findall(r"\d+", said)[0]))
                self._press("r")
            for key in (STAGES[verdict.stage][0], TYPES[verdict.deviation][0], "Enter"):
                self._press(key)

    def _read(self, frame: int) -> Reading:
        """Goes to a frame, by tens and ones, and reads its numbers."""
        by = frame - self._at
        key = "ArrowRight" if by > 0 else "ArrowLeft"
        for keys, count in ((f"Shift+{key}", abs(by) // 10), (key, abs(by) % 10)):
            for _ in range(count):
                self._press(keys)
        self._at = frame
        self._wait(_AT, frame)
        found = self.looks[-1].readings[frame] = self._page.evaluate(READ)["rows"]
        return found

    def _wait(self, wanted: str, *values: Any) -> None:
        self._page.wait_for_function(wanted, arg=list(values))

    def _press(self, key: str) -> None:
        self._page.keyboard.press(key)
