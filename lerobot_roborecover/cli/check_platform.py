"""`roborecover check platform`."""

from __future__ import annotations

import argparse
import json
import sys

HELP = "Check that a platform rebuilds its states exactly, before scenarios are recorded on it."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("platform", metavar="NAME", help="e.g. metaworld, or one that another distribution registers")
    add(
        "--task", dest="tasks", action="append", default=[], metavar="PATTERN",
        help="suite, task, or suite/task, with * and ?; repeat it for several (the first two tasks)",
    )  # fmt: skip
    add("--steps", type=int, default=40, help="random actions of a run (%(default)s)")
    add("--seed", type=int, default=0, help="of the actions (%(default)s)")
    add(
        "--options", type=json.loads, default={}, metavar="JSON",
        help="of the simulator, e.g. '{\"obs_type\": \"state\"}'",
    )  # fmt: skip
    add("--json", action="store_true", help="print the checks as one JSON object")


def run(args: argparse.Namespace) -> int:
    """Runs the checks, a line each as they end; 0 when none failed, 1 otherwise."""
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.platforms import platform_named
    from lerobot_roborecover.platforms.check import TASKS, CheckRequest, check_platform
    from lerobot_roborecover.platforms.findings import check_lines, count_line, report_json
    from lerobot_roborecover.platforms.names import choose_tasks

    if not 2 <= args.steps <= 100_000:
        raise OptionError(f"--steps={args.steps}: 2 to 100000")
    if not isinstance(args.options, dict):
        raise OptionError(f"--options={args.options!r:.80}: a JSON object of the simulator's options")
    platform = platform_named(args.platform).resolve(())  # of an env type of several, its first
    every = platform.tasks(args.options)
    tasks = tuple(choose_tasks(every, args.tasks) if args.tasks else every[:TASKS])
    request = CheckRequest(platform.name, tasks, args.options, args.steps, args.seed)
    checks = []
    for check in check_platform(request):
        checks.append(check)
        if not args.json:
            print("\n".join(check_lines(check)), flush=True)
    print(json.dumps(report_json(checks), indent=2) if args.json else count_line(checks))
    if not args.json and any(check.failed for check in checks):
        print("scenarios of this platform could not be rebuilt exactly", file=sys.stderr)
    return int(any(check.failed for check in checks))
