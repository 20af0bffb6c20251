"""`roborecover curate teleop`."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "Drive a simulator in the browser: make a deviation, mark it, complete the task all the same."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("dataset", type=Path, help="the candidate dataset: a new folder, or one that this command made")
    add("--platform", default="metaworld", help="which can be driven by hand, e.g. libero (%(default)s)")
    add("--operator", metavar="NAME", help="your name or a pseudonym; the controller in the dataset")
    add("--task", dest="tasks", action="append", default=[], metavar="NAME", help="repeat it for several")
    add("--suite", default="", help="where several suites have a task of that name")
    add("--seeds", metavar="LIST", help="of the starts, e.g. 0-9,12 (0; on LIBERO 7)")
    add("--init-states", metavar="LIST", help="of the starts, on LIBERO (0)")
    add(
        "--continue", dest="continued", nargs=3, action="append", default=[],
        metavar=("DATASET", "ID", "STEP"),
        help="start some steps into a candidate's rollout; repeat it for several",
    )  # fmt: skip
    add("--port", type=int, default=8732, help="on this machine alone; 0 takes a free one (%(default)s)")
    add("--rate", type=float, metavar="HZ", help="control steps a second, at most (the simulator's own rate)")
    add("--fps", type=float, default=15.0, help="live pictures a second, at most (%(default)s)")
    add("--view", type=int, default=320, metavar="PIXELS", help="size of the live pictures (%(default)s)")
    add("--size", type=int, metavar="PIXELS", help="of the dataset's pictures; 0: none (the platform's own)")
    add(
        "--spacemouse", type=float, nargs="?", const=0.5, metavar="SPEED",
        help="drive with one that is plugged into this machine, too; SPEED is up to 1 (%(const)s)",
    )  # fmt: skip
    add("--assets-dir", help="LIBERO's assets (found by itself where LeRobot finds them)")
    add("--write", action="store_true", help="only write what earlier sessions saved into the dataset")


def run(args: argparse.Namespace) -> int:
    """Serves the page until interrupted, then writes the dataset."""
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.web.teleop.serve import TeleopConfig, serve, write
    from lerobot_roborecover.web.teleop.starts import continued, first_states

    def say(line: str) -> None:
        print(line, flush=True)

    for option, value, low, high in (
        ("--rate", args.rate, 0.1, 1000.0),
        ("--fps", args.fps, 0.1, 120.0),
        ("--view", args.view, 16, 2048),
        ("--size", args.size, 16, 2048),
        ("--spacemouse", args.spacemouse, 0.01, 1.0),
    ):
        if value is not None and not (low <= value <= high or (option == "--size" and value == 0)):
            raise OptionError(f"{option} {value} is not from {low:g} to {high:g}")
    if not (args.write or args.operator):
        raise OptionError("--operator is missing: your name, or a pseudonym")
    starts = first_states(args.platform, args.tasks, args.suite, args.seeds, args.init_states)
    for dataset, name, step in args.continued:
        if not step.isdecimal():
            raise OptionError(f"--continue {dataset} {name} {step}: the last one is a number of steps")
        starts.append(continued(Path(dataset), name, int(step)))
    config = TeleopConfig(
        dataset=args.dataset,
        platform=args.platform,
        operator=args.operator or "",
        starts=starts,
        port=args.port,
        rate_hz=args.rate,
        fps=args.fps,
        view_size=args.view,
        size=args.size,
        spacemouse=args.spacemouse,
        options={"assets_dir": args.assets_dir} if args.assets_dir else {},
    )
    if args.write:
        write(config, say)
    else:
        serve(config, say)
    return 0
