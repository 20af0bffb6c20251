"""The demo from end to end: evaluate from both starts, print the table, write the page."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from lerobot_roborecover.analysis.pages.pictures import render_frames
from lerobot_roborecover.analysis.summary import format_table, summarise
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.demo.evaluate import eval_command, evaluate
from lerobot_roborecover.demo.page import write_page
from lerobot_roborecover.demo.settings import DemoSettings, hold_folder
from lerobot_roborecover.evaluation.progress import RunProgress
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.scenario import Scenario

STARTS = ("recovery", "initial")


def run_demo(settings: DemoSettings) -> Path:
    """Runs the demo, or what is left of it.

    Args:
        settings: what to run and where.

    Returns:
        The page.

    Raises:
        DemoError: the folder is taken, or `lerobot-eval` failed.
        ScenarioError: the scenarios cannot be loaded, or the selection is empty.
    """
    found = load_scenarios(settings.scenarios, select=settings.select)
    scenarios = spread(tuple(found), settings.limit)
    with hold_folder(settings):
        return _run(settings, found.platform, scenarios)


def _run(settings: DemoSettings, platform: str, scenarios: Sequence[Scenario]) -> Path:
    ids = [s.id for s in scenarios]
    commands = [shlex.join(eval_command(settings, platform, ids, start)) for start in STARTS]
    _say(f"{len(ids)} scenarios, {settings.trials} trial(s) each, from recovery and from initial starts")
    for start in STARTS:
        evaluate(settings, platform, ids, start)
    counts = [RunProgress(start, ids, settings.trials) for start in STARTS]

    def wanted(row: TrialRow) -> bool:
        return any(count.wanted(asdict(row)) for count in counts)

    rows = [asdict(row) for row in read_trial_log(settings.trial_log) if wanted(row)]
    summary = summarise(rows, settings.trials)
    print(f"\n{format_table(summary)}\n", flush=True)
    frames, problem = {}, "they were not asked for"
    if settings.pictures:
        _say("rendering the recovery frames ...")
        frames, problem = render_frames(scenarios, settings.out / "frames")
        if problem:
            _say(f"pictures are missing: {problem}")
    page = write_page(
        settings.trial_log,
        settings.out,
        wanted=wanted,
        trials=settings.trials,
        frames=frames,
        problem=problem,
        commands=commands,
    )
    for label, path in (("page", page), ("trial log", settings.trial_log)):
        print(f"{label:<10}{path}")
    for start in STARTS:
        print(f"{'results' if start == STARTS[0] else '':<10}{settings.out / start / 'eval_info.json'}")
    return page


def spread(scenarios: Sequence[Scenario], limit: int | None) -> list[Scenario]:
    """At most `limit` scenarios, evenly spaced over the set."""
    if limit is None or limit >= len(scenarios):
        return list(scenarios)
    return [scenarios[i * len(scenarios) // limit] for i in range(limit)]


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
