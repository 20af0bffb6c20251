"""`roborecover check platform`."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import Any

from lerobot_roborecover.platforms.check import STEPS
from lerobot_roborecover.utils.options import json_object, option

HELP = "Check that a platform rebuilds its states exactly, before scenarios are recorded on it."


@dataclass(frozen=True, kw_only=True)
class CheckPlatformOptions:
    """What to check."""

    platform: str = option(positional=True, metavar="NAME")
    """A platform, e.g. metaworld, or one that another distribution registers."""
    tasks: tuple[str, ...] = option((), name="task", metavar="PATTERN")
    """Suite, task, or suite/task, with * and ?; repeat it for several (the first two tasks)."""
    steps: int = STEPS
    """Random actions of a run."""
    seed: int = 0
    """Seed of the actions."""
    simulator: dict[str, Any] = option(
        factory=dict,
        name="options",
        metavar="JSON",
        parse=json_object("--options", "the simulator's options"),
    )
    """Options of the simulator, e.g. '{"obs_type": "state"}'."""
    as_json: bool = option(False, name="json")
    """Print the checks as one JSON object."""


OPTIONS = CheckPlatformOptions


def run(options: CheckPlatformOptions) -> int:
    """Runs the checks, a line each as they end; 0 when none failed, 1 otherwise."""
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.platforms import platform_named
    from lerobot_roborecover.platforms.catalog import choose_tasks
    from lerobot_roborecover.platforms.check import TASKS, CheckRequest, check_platform
    from lerobot_roborecover.platforms.findings import check_lines, count_line, report_json

    if not 2 <= options.steps <= 100_000:
        raise OptionError(f"--steps={options.steps}: 2 to 100000")
    platform = platform_named(options.platform).resolve(())  # of an env type of several, its first
    every = platform.tasks(options.simulator)
    tasks = tuple(choose_tasks(every, options.tasks) if options.tasks else every[:TASKS])
    request = CheckRequest(platform.name, tasks, options.simulator, options.steps, options.seed)
    checks = []
    for check in check_platform(request):
        checks.append(check)
        if not options.as_json:
            print("\n".join(check_lines(check)), flush=True)
    print(json.dumps(report_json(checks), indent=2) if options.as_json else count_line(checks))
    if not options.as_json and any(check.failed for check in checks):
        print("scenarios of this platform could not be rebuilt exactly", file=sys.stderr)
    return int(any(check.failed for check in checks))
