"""`roborecover detect data`."""

from __future__ import annotations

import argparse
from pathlib import Path

from lerobot_roborecover.cli.old_options import renamed
from lerobot_roborecover.datasets.licenses import license_argument

HELP = (
    "Make the frames that a monitor is trained and measured on: screening policies continue each scenario "
    "once; label 0 before the recovery point, 1 from it on; split by scenario."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("--scenarios", required=True, help="scenario set: folder, Hub id or shipped name")
    add("--revision", help="commit, tag or branch of that set on the Hub")
    add("--split", default="train", help="take this split of it only (%(default)s)")
    add("--select", default="", help="which scenarios, e.g. 'suite=libero_goal; source=natural'")
    add("--policy", action="append", default=[], metavar="CHECKPOINT", help="screening policy; give it again")
    add(
        "--trials-from", action="append", default=[], type=Path, metavar="DIR",
        help="folder of a policy's trials with their actions, e.g. SCREENED.trials/NAME: the first of each "
        "scenario is not run again; may be given again",
    )  # fmt: skip
    add(
        "--rollouts", action="append", default=[], type=Path, metavar="DIR",
        help="recorded continuations: a trajectory dataset whose episodes belong to the scenarios",
    )  # fmt: skip
    add("--out", required=True, type=Path, help="folder of the three datasets")
    add("--work", type=Path, help="folder of the policies' trials, kept between runs (OUT.trials)")
    add(
        "--validation",
        type=float,
        default=0.1,
        help="held-out share or number; 1: all (%(default)s)",
    )
    add("--split-by", default="scenario", choices=("scenario", "cluster"), help="(%(default)s)")
    add("--natural-training", action="store_true", help="do not balance the labels of the training part")
    add("--train-frames", type=int, help="frames of the training part (all that balance allows)")
    add("--balanced-frames", type=int, help="frames of the balanced validation (all that balance allows)")
    add("--natural-frames", type=int, help="frames of the natural validation (every one)")
    add("--stride", type=int, default=1, metavar="N", help="choose among every N-th step only (%(default)s)")
    add("--seed", type=int, default=0, help="of the split and the choice of frames (%(default)s)")
    add("--run-seed", type=int, default=1000, help="of the policies' trials (%(default)s)")
    add("--device", help="of the policies")
    add("--num-workers", type=int, default=1, help="processes that replay and render (%(default)s)")
    add(
        "--license",
        type=license_argument,
        help="licence by the Hub's identifier, of the frames; none is assumed",
    )
    add(
        "--env", action="append", default=[], metavar="NAME=VALUE",
        help="option of the recovery env type, e.g. obs_type=state; may be given again",
    )  # fmt: skip
    add(
        "--frames", action="append", default=[], metavar="NAME=VALUE",
        help="the same for the rendered frames alone, where they differ from what the policies see",
    )  # fmt: skip
    renamed(parser, "--stride", "--every")
    renamed(parser, "--num-workers", "--workers")


def run(args: argparse.Namespace) -> int:
    """Makes the data and prints the counts."""
    import datasets

    from lerobot_roborecover.detection.data.choice import TRAIN, DataOptions
    from lerobot_roborecover.detection.data.request import MonitorRequest, make_monitor_data
    from lerobot_roborecover.utils.progress import Progress
    from lerobot_roborecover.utils.text import align

    datasets.disable_progress_bars()  # LeRobot's writer shows one per episode
    choice = DataOptions(
        validation=args.validation,
        split_by=args.split_by,
        train_balanced=not args.natural_training,
        train_frames=args.train_frames,
        balanced_frames=args.balanced_frames,
        natural_frames=args.natural_frames,
        every=args.stride,
        seed=args.seed,
    )
    request = MonitorRequest(
        scenarios=args.scenarios,
        out=args.out,
        policies=args.policy,
        trials_from=args.trials_from,
        rollouts=args.rollouts,
        revision=args.revision,
        split=args.split,
        select=args.select,
        work=args.work,
        env=args.env,
        frames=args.frames,
        choice=choice,
        run_seed=args.run_seed,
        device=args.device,
        workers=args.num_workers,
        license=args.license,
    )
    made = make_monitor_data(request, Progress("frame").of)
    columns = {
        "ids": "IDs",
        "trajectories": "traj.",
        "frames": "frames",
        "label0": "label 0",
        "label1": "label 1",
    }
    rows = [[part, *(c[name] for name in columns)] for part, c in made.counts.items()]
    print("\n".join(align([["", *columns.values()], *rows])))
    for reason, n in made.dropped.most_common():
        print(f"left out {n}: {reason}")
    if TRAIN in made.counts:
        config = "policies/train/monitor_small.yaml"
        print(f"\nlerobot-train --config_path={config} --dataset.root={args.out / TRAIN}")
    return 0
