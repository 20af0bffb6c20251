"""`roborecover curate teleop`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lerobot_roborecover.utils.options import option
from lerobot_roborecover.web.teleop.serve import TeleopConfig, serve, write

HELP = "Drive a simulator in the browser: make a deviation, mark it, complete the task all the same."


@dataclass(frozen=True, kw_only=True)
class TeleopOptions(TeleopConfig):
    """One operator's session; the starts as they are written on a command line."""

    tasks: tuple[str, ...] = option((), name="task", metavar="NAME")
    """Repeat it for several."""
    suite: str = ""
    """Where several suites have a task of that name."""
    seeds: str | None = option(None, metavar="LIST")
    """Seeds of the starts, e.g. 0-9,12 (0; on LIBERO 7)."""
    init_states: str | None = option(None, metavar="LIST")
    """Init states of the starts, on LIBERO (0)."""
    continued: Sequence[tuple[str, str, str]] = option((), name="continue", metavar=("DATASET", "ID", "STEP"))
    """Start some steps into a candidate's rollout; repeat it for several."""
    assets_dir: str | None = None
    """LIBERO's assets (found by itself where LeRobot finds them)."""
    write: bool = False
    """Only write what earlier sessions saved into the dataset."""


OPTIONS = TeleopOptions


def run(options: TeleopOptions) -> int:
    """Serves the page until interrupted, then writes the dataset."""
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.web.teleop.starts import continued, first_states

    def say(line: str) -> None:
        print(line, flush=True)

    for name, value, low, high in (
        ("--rate", options.rate_hz, 0.1, 1000.0),
        ("--fps", options.fps, 0.1, 120.0),
        ("--view", options.view_size, 16, 2048),
        ("--size", options.size, 16, 2048),
        ("--spacemouse", options.spacemouse, 0.01, 1.0),
    ):
        if value is not None and not (low <= value <= high or (name == "--size" and value == 0)):
            raise OptionError(f"{name} {value} is not from {low:g} to {high:g}")
    if not (options.write or options.operator):
        raise OptionError("--operator is missing: your name, or a pseudonym")
    starts = first_states(options.platform, options.tasks, options.suite, options.seeds, options.init_states)
    for dataset, rollout, step in options.continued:
        if not step.isdecimal():
            raise OptionError(f"--continue {dataset} {rollout} {step}: the last one is a number of steps")
        starts.append(continued(Path(dataset), rollout, int(step)))
    simulator = {"assets_dir": options.assets_dir} if options.assets_dir else {}
    config = replace(options, starts=starts, options=simulator)
    if options.write:
        write(config, say)
    else:
        serve(config, say)
    return 0
