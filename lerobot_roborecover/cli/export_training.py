"""`roborecover curate training-data`."""

from __future__ import annotations

import argparse
from pathlib import Path

from lerobot_roborecover.cli.old_options import renamed
from lerobot_roborecover.datasets.licenses import license_argument

HELP = (
    "Make a dataset for lerobot-train from trials, forks and donors, each frame with success, intervention, "
    "progress and advantage."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add(
        "sources", nargs="+", type=Path,
        help="trial logs of runs with --env.record_actions=true, logs of `detect fork`, folders of donors",
    )  # fmt: skip
    add("--scenarios", required=True, help="scenario set of the trials: folder, Hub id or shipped name")
    add("--revision", help="commit, tag or branch of that set on the Hub")
    add("--split", default="train", help="take this split of it only (%(default)s)")
    add("--out", required=True, type=Path, help="folder of the dataset; new or empty")
    add(
        "--outcome",
        default="all",
        choices=("all", "successes", "failures"),
        help="which trials (%(default)s)",
    )
    add("--num-workers", type=int, default=1, help="processes that replay and render (%(default)s)")
    add(
        "--statistics-of", metavar="CHECKPOINT",
        help="normalise as this checkpoint does, whose training goes on here",
    )  # fmt: skip
    add("--license", type=license_argument, help="licence by the Hub's identifier; none is assumed")
    add(
        "--env", action="append", default=[], metavar="NAME=VALUE",
        help="option of the recovery env type, e.g. obs_type=state; may be given again",
    )  # fmt: skip
    renamed(parser, "--outcome", "--of")
    renamed(parser, "--num-workers", "--workers")


def run(args: argparse.Namespace) -> int:
    """Reads, replays, writes; says what was left out."""
    from collections import Counter

    from lerobot_roborecover.curation.normalisation import use_statistics_of
    from lerobot_roborecover.curation.policy_trials import env_config
    from lerobot_roborecover.curation.training.export import PROGRESS_FILE, export_training
    from lerobot_roborecover.curation.training.lines import (
        TrainingLine,
        lines_of_dataset,
        lines_of_log,
        policies_of,
        without_test,
    )
    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.datasets.trajectories import read_trajectories
    from lerobot_roborecover.utils.atomic_io import check_new
    from lerobot_roborecover.utils.progress import Progress

    check_new(args.out)
    scenarios = load_scenarios(args.scenarios, revision=args.revision, split=args.split)
    by_id = {s.id: s for s in scenarios}
    dropped: Counter = Counter()
    lines: list[TrainingLine] = []
    for source in args.sources:
        if source.is_dir():
            lines += lines_of_dataset(read_trajectories(source), by_id, dropped)
        else:
            lines += lines_of_log(source, by_id, dropped, args.outcome)
    lines = without_test(lines, dropped)
    spec = env_config(scenarios.platform, args.scenarios, [f"--{o}" for o in args.env]).run_spec()

    def finish(folder: Path) -> None:
        if args.statistics_of:
            use_statistics_of(folder, Path(args.statistics_of))

    made = export_training(
        args.out, lines, simulator=spec.slot.options, workers=args.num_workers, dropped=dropped,
        description=f"Trials by {', '.join(policies_of(lines))}, for training.", license=args.license,
        on_episode=Progress("episode"), also=finish,
    )  # fmt: skip
    for reason, count in dropped.most_common():
        print(f"left out: {count} {reason}")
    print(
        f"{made.episodes} episodes ({made.successes} succeed), {made.frames} frames, {made.interventions} of "
        f"them by an intervention\n\nlerobot-train --dataset.repo_id=local/training "
        f"--dataset.root={args.out} --policy.type=... --output_dir=...\n"
        f"with RA-BC ({PROGRESS_FILE}): --sample_weighting.type=rabc"
        + ("" if made.progress_known else " --sample_weighting.head_mode=dense")
    )
    return 0
