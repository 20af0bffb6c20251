"""`roborecover dataset inspect`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

HELP = "Show what a scenario dataset holds; replay one scenario to pictures, a video and a rerun recording."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("dataset", help="folder, shipped name or Hub id")
    add("--revision", help="of a Hub dataset: tag, branch or commit")
    add("--split", help="this split only")
    add("--select", default="", help="which scenarios, e.g. 'cell=Approach-*; source=natural'")
    add("--scenario", metavar="ID", help="replay this one and write first.png, recovery.png and prefix.mp4")
    add("--rrd", action="store_true", help="with --scenario: also replay.rrd, for the rerun viewer")
    add(
        "--out", type=Path, default=Path("outputs/inspect"), help="with --scenario: where to (%(default)s/ID)"
    )
    add("--frames", action="store_true", help="with --scenario: also every frame, as frames/STEP.png")
    add(
        "--size",
        type=int,
        default=256,
        help="with --scenario: picture side in pixels (%(default)s); RoboTwin's own configuration says its",
    )
    add(
        "--render-quality",
        help="where the platform has several (RoboTwin: rt, default, ...)",
    )


def run(args: argparse.Namespace) -> int:
    """Prints the tables, or replays one scenario."""
    from lerobot_roborecover.datasets.inspect import describe, summary, write_scenario
    from lerobot_roborecover.datasets.load import load_scenarios
    from lerobot_roborecover.platforms import make_simulator
    from lerobot_roborecover.scenario import ScenarioError

    found = load_scenarios(args.dataset, revision=args.revision, split=args.split, select=args.select)
    if args.scenario is None:
        print(summary(found))
        return 0
    if args.scenario not in found:
        shown = ", ".join(found.ids[:5])
        raise ScenarioError(f"{found.source} has no scenario {args.scenario!r:.140}; there are {shown}, ...")
    scenario = found[args.scenario]
    print(describe(scenario))
    simulator = make_simulator(scenario.platform, **_options(args, scenario.platform))
    print(f"replaying {len(scenario.prefix)} actions ...", file=sys.stderr)
    try:
        for path in write_scenario(
            simulator, scenario, args.out / scenario.id, recording=args.rrd, frames=args.frames
        ):
            print(path)
    finally:
        simulator.close()
    return 0


def _options(args: argparse.Namespace, platform: str) -> dict[str, Any]:
    """Options of the simulator that say how the pictures are to look."""
    from lerobot_roborecover.platforms import platform_named

    quality = {} if args.render_quality is None else {"render_quality": args.render_quality}
    return platform_named(platform).picture_options(args.size) | quality
