"""Runs automatic annotators: the real server, and for each annotator a browser of its own at its own address,
as many at once as there are cores. What has a vote already is left out, so that a run that was stopped goes
on."""

from __future__ import annotations

import multiprocessing
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from typing import Any

from lerobot_roborecover.build.annotate.serve import AnnotateConfig, serve
from lerobot_roborecover.build.auto_annotate.annotators import EYES
from lerobot_roborecover.build.auto_annotate.browser import SLOW_MS, browser
from lerobot_roborecover.build.auto_annotate.page import Annotator
from lerobot_roborecover.env.parent import end_with_parent
from lerobot_roborecover.evaluate.sizes import usable_cores
from lerobot_roborecover.scenario import ScenarioError

START_S = 120.0
"""Longest that the server may take to start."""
VIEWPORT = {"width": 900, "height": 640}
"""Nobody looks at it, and painting is what costs."""
_SAY_EVERY = 20


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
    with _server(config) as addresses:
        waiting = [(name, addresses[name]) for name in config.annotators]
        working: dict[Connection, Any] = {}
        try:
            while waiting or working:
                while waiting and len(working) < usable_cores():
                    process, lines = _start(_work, *waiting.pop(0))
                    working[lines] = process
                for lines in wait(list(working)):
                    assert isinstance(lines, Connection)
                    _hear(lines, working, say)
        finally:
            for process in working.values():
                _end(process)


def _hear(lines: Connection, working: dict[Connection, Any], say: Callable[[str], None]) -> None:
    """Passes on what an annotator says."""
    try:
        kind, text = lines.recv()
    except EOFError:
        process = working.pop(lines)
        process.join()
        if process.exitcode:
            raise ScenarioError(
                f"an automatic annotator's process ended with status {process.exitcode}; what it said is "
                "above. Every vote so far is kept: run the command again"
            ) from None
        return
    if kind == "error":
        raise ScenarioError(text)
    say(text)


def _work(name: str, address: str, said: Connection) -> None:
    """One annotator, in a process of its own: Playwright wants no threads."""
    try:
        with browser() as made:
            page = made.new_context(viewport=VIEWPORT).new_page()
            page.set_default_timeout(SLOW_MS)
            page.goto(address)
            page.wait_for_selector("#cameras canvas[data-episode]", state="attached")
            _all(name, Annotator(page, EYES[name]), lambda line: said.send(("line", line)))
    except ScenarioError as err:
        said.send(("error", str(err)))


def _start(work: Callable[..., None], *arguments: Any) -> tuple[Any, Connection]:
    """A process that does the work, and what it says."""
    context = multiprocessing.get_context("spawn")
    mine, its = context.Pipe(duplex=False)
    # Not a daemon: it starts a browser.
    process = context.Process(target=_with_parent, args=(work, os.getpid(), *arguments, its))
    process.start()
    its.close()
    return process, mine


def _with_parent(work: Callable[..., None], parent: int, *arguments: Any) -> None:
    end_with_parent(parent)
    work(*arguments)


def _end(process: Any) -> None:
    process.terminate()
    process.join(10)
    if process.is_alive():
        process.kill()


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


@contextmanager
def _server(config: AnnotateConfig) -> Iterator[dict[str, str]]:
    """The annotation server as a process of its own; yields each annotator's address."""
    process, mine = _start(_serve, config)
    try:
        yield _addresses(mine, process, config.annotators)
    finally:
        _end(process)


def _addresses(lines: Connection, process: Any, names: Sequence[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    until = time.monotonic() + START_S
    while len(found) < len(names):
        if not lines.poll(max(until - time.monotonic(), 0.0)):
            raise ScenarioError(f"the annotation server did not start within {START_S:g} s")
        try:
            kind, text = lines.recv()
        except EOFError:
            raise ScenarioError(f"the annotation server ended with status {process.exitcode}") from None
        if kind == "error":
            raise ScenarioError(text)
        match = re.fullmatch(r"(\S+): .* (http://\S+)", text)
        if match:
            found[match[1]] = match[2]
    return found


def _serve(config: AnnotateConfig, said: Connection) -> None:
    try:
        serve(config, lambda line: said.send(("line", line)))
    except ScenarioError as err:
        said.send(("error", str(err)))
