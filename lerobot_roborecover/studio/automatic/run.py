"""Runs automatic annotators: the real server, and for each annotator a browser of its own at its own address,
as many at once as there are cores. What has a vote already is left out, so that a run that was stopped goes
on."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from multiprocessing.connection import wait
from pathlib import Path

from lerobot_roborecover.curation.annotation.annotators import EYES
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.studio.annotate.serve import AnnotateConfig, serve
from lerobot_roborecover.studio.automatic.browser import SLOW_MS, browser
from lerobot_roborecover.studio.automatic.page import Annotator
from lerobot_roborecover.studio.line_process import LineProcess
from lerobot_roborecover.trials.sizes import usable_cores

START_S = 120.0
"""Longest that the server may take to start."""
VIEWPORT = {"width": 900, "height": 640}
"""Nobody looks at it, and painting is what costs."""
_SAY_EVERY = 20


def session(
    dataset: Path, votes: Path | None = None, seed: int = 0, only: Path | None = None
) -> AnnotateConfig:
    """A session of every automatic annotator, at a free port.

    Args:
        dataset: a candidate dataset.
        votes: folder of all votes; by default inside the dataset.
        seed: of the queues' order.
        only: a list of candidates to discuss.
    """
    return AnnotateConfig(dataset, tuple(EYES), 0, votes, seed, only, examples=False)


def annotate(config: AnnotateConfig, say: Callable[[str], None]) -> None:
    """Has every candidate annotated by the automatic annotators that are named.

    Args:
        config: the session; annotators are names of `EYES`.
        say: told the progress.

    Raises:
        ScenarioError: a name is none of them, or server, browser or page do not work.
    """
    unknown = [name for name in config.annotators if name not in EYES]
    if unknown:
        raise ScenarioError(
            f"there is no automatic annotator {unknown[0]!r:.80}; there are {', '.join(EYES)}"
        )
    with LineProcess("the annotation server", serve, config) as server, ExitStack() as browsers:
        addresses = _addresses(server, config.annotators)
        waiting = [(name, addresses[name]) for name in config.annotators]
        working: set[LineProcess] = set()
        while waiting or working:
            while waiting and len(working) < usable_cores():
                name, address = waiting.pop(0)
                annotator = LineProcess(f"the automatic annotator {name}", _work, name, address)
                working.add(browsers.enter_context(annotator))
            ready = wait([annotator.fileno() for annotator in working])
            for annotator in [a for a in working if a.fileno() in ready]:
                line = annotator.hear()
                if line is None:
                    working.remove(annotator)
                else:
                    say(line)


def _work(name: str, address: str, say: Callable[[str], None]) -> None:
    """One annotator, in a process of its own: Playwright wants no threads."""
    with browser() as made:
        page = made.new_context(viewport=VIEWPORT).new_page()
        page.set_default_timeout(SLOW_MS)
        page.goto(address)
        page.wait_for_selector("#cameras canvas[data-episode]", state="attached")
        _all(name, Annotator(page, EYES[name]), say)


def _all(name: str, annotator: Annotator, say: Callable[[str], None]) -> None:
    total, after, began = annotator.left(), "", time.monotonic()
    outcomes: Counter[str] = Counter()
    for number in range(1, total + 1):
        after, verdict = annotator.annotate(after)
        outcomes[verdict.discard or f"{verdict.stage}-{verdict.deviation}"] += 1
        if number % _SAY_EVERY == 0 or number == total:
            each = (time.monotonic() - began) / number
            say(f"{name}: {number} of {total}, {each:.2f} s an episode")
    annotator.saved()
    say(f"{name}: " + (", ".join(f"{n} {what}" for what, n in outcomes.most_common()) or "nothing to do"))


def _addresses(server: LineProcess, names: Sequence[str]) -> dict[str, str]:
    """Each annotator's address, once the server has said them all."""
    found: dict[str, str] = {}
    until = time.monotonic() + START_S
    while len(found) < len(names):
        line = server.hear(until)
        if line is None:
            raise ScenarioError("the annotation server ended before it gave an address")
        match = re.fullmatch(r"(\S+): .* (http://\S+)", line)
        if match:
            found[match[1]] = match[2]
    return found
