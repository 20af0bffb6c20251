"""`roborecover curate training-data`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lerobot_roborecover.datasets.licenses import license_argument
from lerobot_roborecover.utils.options import option

HELP = (
    "Make a dataset for lerobot-train from trials, forks and donors, each frame with success, intervention, "
    "progress and advantage."
)


@dataclass(frozen=True, kw_only=True)
class TrainingSetOptions:
    """Options of every command that makes a dataset for lerobot-train from trials."""

    scenarios: str
    """Scenario set of the trials: folder, Hub id or shipped name."""
    revision: str | None = None
    """Commit, tag or branch of that set on the Hub."""
    split: str = "train"
    """Take this split of it only."""
    out: Path
    """Folder of the dataset; new or empty."""
    num_workers: int = option(1, old=("workers",))
    """Processes that replay and render."""
    statistics_of: str | None = option(None, metavar="CHECKPOINT")
    """Normalise as this checkpoint does, whose training goes on here."""
    license: str | None = option(None, parse=license_argument)
    """Licence by the Hub's identifier; none is assumed."""
    env: tuple[str, ...] = option((), metavar="NAME=VALUE")
    """Option of the recovery env type, e.g. obs_type=state; may be given again."""


@dataclass(frozen=True, kw_only=True)
class TrainingDataOptions(TrainingSetOptions):
    """Which trials become training data."""

    sources: tuple[Path, ...] = option(positional=True)
    """Trial logs of runs with --env.record_actions=true, logs of `detect fork`, folders of donors."""
    outcome: Literal["all", "successes", "failures"] = option("all", old=("of",))
    """Which trials."""


OPTIONS = TrainingDataOptions


def run(options: TrainingDataOptions) -> int:
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
        trainable,
    )
    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.datasets.trajectories import read_trajectories
    from lerobot_roborecover.utils.atomic_io import check_new
    from lerobot_roborecover.utils.progress import Progress

    check_new(options.out)
    scenarios = load_scenarios(options.scenarios, revision=options.revision, split=options.split)
    by_id = {s.id: s for s in scenarios}
    dropped: Counter = Counter()
    lines: list[TrainingLine] = []
    for source in options.sources:
        if source.is_dir():
            lines += lines_of_dataset(read_trajectories(source), by_id, dropped)
        else:
            lines += lines_of_log(source, by_id, dropped, options.outcome)
    lines = trainable(lines, dropped)
    spec = env_config(scenarios.platform, options.scenarios, [f"--{o}" for o in options.env]).run_spec()

    def finish(folder: Path) -> None:
        if options.statistics_of:
            use_statistics_of(folder, Path(options.statistics_of))

    made = export_training(
        options.out, lines, simulator=spec.slot.options, workers=options.num_workers, dropped=dropped,
        description=f"Trials by {', '.join(policies_of(lines))}, for training.", license=options.license,
        on_episode=Progress("episode"), also=finish,
    )  # fmt: skip
    for reason, count in dropped.most_common():
        print(f"left out: {count} {reason}")
    print(
        f"{made.episodes} episodes ({made.successes} succeed), {made.frames} frames, {made.interventions} of "
        f"them by an intervention\n\nlerobot-train --dataset.repo_id=local/training "
        f"--dataset.root={options.out} --policy.type=... --output_dir=...\n"
        f"with RA-BC ({PROGRESS_FILE}): --sample_weighting.type=rabc"
        + ("" if made.progress_known else " --sample_weighting.head_mode=dense")
    )
    return 0
