"""`roborecover dataset inspect`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_roborecover.utils.options import option

HELP = "Show what a scenario dataset holds; replay one scenario to pictures, a video and a rerun recording."


@dataclass(frozen=True, kw_only=True)
class InspectOptions:
    """What to show."""

    dataset: str = option(positional=True)
    """Folder, shipped name or Hub id."""
    revision: str | None = None
    """Revision of a Hub dataset: tag, branch or commit."""
    split: str | None = None
    """This split only."""
    select: str = ""
    """Which scenarios, e.g. 'cell=Approach-*; source=natural'."""
    scenario: str | None = option(None, metavar="ID")
    """Replay this one and write first.png, recovery.png and prefix.mp4."""
    rrd: bool = False
    """With --scenario: also replay.rrd, for the rerun viewer."""
    out: Path = Path("outputs/inspect")
    """With --scenario: where to ({default}/ID)."""
    frames: bool = False
    """With --scenario: also every frame, as frames/STEP.png."""
    size: int = 256
    """With --scenario: picture side in pixels ({default}); RoboTwin's own configuration says its."""
    render_quality: str | None = None
    """Where the platform has several (RoboTwin: rt, default, ...)."""


OPTIONS = InspectOptions


def run(options: InspectOptions) -> int:
    """Prints the tables, or replays one scenario."""
    from lerobot_roborecover.datasets.inspect import describe, summary, write_scenario
    from lerobot_roborecover.datasets.load import load_scenarios
    from lerobot_roborecover.platforms import make_simulator
    from lerobot_roborecover.scenario import ScenarioError

    found = load_scenarios(
        options.dataset, revision=options.revision, split=options.split, select=options.select
    )
    if options.scenario is None:
        print(summary(found))
        return 0
    if options.scenario not in found:
        shown = ", ".join(found.ids[:5])
        raise ScenarioError(
            f"{found.source} has no scenario {options.scenario!r:.140}; there are {shown}, ..."
        )
    scenario = found[options.scenario]
    print(describe(scenario))
    simulator = make_simulator(scenario.platform, **_options(options, scenario.platform))
    print(f"replaying {len(scenario.prefix)} actions ...", file=sys.stderr)
    try:
        for path in write_scenario(
            simulator, scenario, options.out / scenario.id, recording=options.rrd, frames=options.frames
        ):
            print(path)
    finally:
        simulator.close()
    return 0


def _options(options: InspectOptions, platform: str) -> dict[str, Any]:
    """Options of the simulator that say how the pictures are to look."""
    from lerobot_roborecover.platforms import platform_named

    quality = {} if options.render_quality is None else {"render_quality": options.render_quality}
    return platform_named(platform).picture_options(options.size) | quality
