"""`roborecover curate donors`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from lerobot_roborecover.cli.old_options import renamed
from lerobot_roborecover.datasets.licenses import license_argument
from lerobot_roborecover.utils.determinism import pin_policy_kernels

HELP = (
    "Make the dataset that Correction is trained on: other policies' recoveries of training scenarios that "
    "the base policy does badly on."
)
MANIFEST_FILE = "donors.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("logs", nargs="+", type=Path, help="trial logs of the base and of the alternatives")
    add("--scenarios", required=True, help="scenario set: folder, Hub id or shipped name")
    add("--revision", help="commit, tag or branch of that set on the Hub")
    add("--split", default="train", help="take this split of it only (%(default)s)")
    add("--base", required=True, help="the base policy: its checkpoint, or its name in the logs")
    add(
        "--donor", action="append", default=[], metavar="CHECKPOINT",
        help="an alternative that is in the logs: run its four trials; give it again for each",
    )  # fmt: skip
    add(
        "--trials-from", action="append", default=[], type=Path, metavar="DIR",
        help="trials with their actions, as an earlier run left them in its --work: read instead of run",
    )  # fmt: skip
    add("--out", required=True, type=Path, help="folder of the dataset; new or empty")
    add("--work", type=Path, help="folder of the donors' trials, kept between runs (OUT.trials)")
    add(
        "--max-base-rate",
        type=float,
        default=0.4,
        help="the base recovers a scenario less often (%(default)s)",
    )
    add(
        "--min-donor-rate",
        type=float,
        default=0.6,
        help="an alternative recovers it more often (%(default)s)",
    )
    add("--trials", type=int, default=4, help="of each candidate (%(default)s)")
    add(
        "--deterministic", action="append", default=[], metavar="CHECKPOINT",
        help="this alternative (or its name in the logs) does the same in every trial: one of each candidate "
        "counts as all",
    )  # fmt: skip
    add("--successes", type=int, default=3, help="of these, at least (%(default)s)")
    add("--per-record", type=int, default=1, help="trajectories per source record (%(default)s)")
    add("--run-seed", type=int, default=2000, help="of the donors' trials (%(default)s)")
    add("--device", help="of the donors")
    add("--num-workers", type=int, default=1, help="processes that replay and render (%(default)s)")
    add(
        "--statistics-of", metavar="CHECKPOINT",
        help="normalise as this checkpoint does, whose training goes on here (default: the base, where "
        "--base is a checkpoint's folder)",
    )  # fmt: skip
    add(
        "--license",
        type=license_argument,
        help="licence by the Hub's identifier, of the trajectories; none is assumed",
    )
    add(
        "--env", action="append", default=[], metavar="NAME=VALUE",
        help="option of the recovery env type, e.g. obs_type=state; may be given again",
    )  # fmt: skip
    renamed(parser, "--max-base-rate", "--base-below")
    renamed(parser, "--min-donor-rate", "--donor-above")
    renamed(parser, "--num-workers", "--workers")


def run(args: argparse.Namespace) -> int:
    """Chooses, runs, judges, writes; prints the funnel."""
    pin_policy_kernels()  # outcomes of these trials are compared with those of a study
    import json

    from lerobot_roborecover.analysis.stats.labels import tell_settings_apart
    from lerobot_roborecover.curation import donors
    from lerobot_roborecover.curation.funnel import StageCounts
    from lerobot_roborecover.curation.normalisation import use_statistics_of
    from lerobot_roborecover.curation.policy_trials import env_config, read_trials, run_trials
    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.datasets.schema import FOLDER
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.logs.trial_log import read_trial_log
    from lerobot_roborecover.policies.identity import policy_identity
    from lerobot_roborecover.utils.atomic_io import atomic_write, check_new
    from lerobot_roborecover.utils.progress import Progress

    check_new(args.out)
    rows = [row for log in args.logs for row in read_trial_log(log)]
    tell_settings_apart(rows)
    names = {row.policy for row in rows}
    base, *alike = (p if p in names else policy_identity(p) for p in (args.base, *args.deterministic))
    trials = [t for folder in args.trials_from for t in read_trials(folder)]
    given = {policy_identity(checkpoint) for checkpoint in args.donor} | {t.row.policy for t in trials}
    stray = sorted(set(alike) - given)
    if stray:
        raise OptionError(
            f"--deterministic {' '.join(stray)}: neither a --donor, nor one whose trials are in "
            f"--trials-from; these are {', '.join(sorted(given)) or 'none'}"
        )
    options = donors.DonorOptions(
        args.max_base_rate, args.min_donor_rate, args.trials, args.successes, args.per_record,
        tuple(alike),
    )  # fmt: skip
    scenarios = load_scenarios(args.scenarios, revision=args.revision, split=args.split)
    funnel: list[StageCounts] = []
    donors.add_step(funnel, f"scenarios of split {args.split}", len(scenarios))
    candidates = donors.choose_candidates(scenarios, rows, base, options, funnel)
    work = args.work or args.out.with_name(f"{args.out.name}.trials")
    progress = Progress("trial")
    for number, checkpoint in enumerate(args.donor):
        name = policy_identity(checkpoint)
        ids = [c.scenario.id for c in candidates if c.policy == name]
        if not ids:
            print(f"{checkpoint}: no candidate is by {name}", file=sys.stderr)
            continue
        which = [f"--split={args.split}", f"--select=id={'|'.join(ids)}"]
        which += [f"--revision={args.revision}"] if args.revision else []
        env = env_config(scenarios.platform, args.scenarios, [*which, *(f"--{o}" for o in args.env)])
        trials += run_trials(
            checkpoint, env, work / f"{number}-{name.replace('/', '--')}", trials=options.trials_of(name),
            seed=args.run_seed, device=args.device,
            on_row=lambda row, done, total: progress.of(f"trials of {row.policy}", done, total),
        )  # fmt: skip
    passed = donors.judge(candidates, trials, options, funnel)
    chosen = donors.deduplicate(passed, options, funnel)
    spec = env_config(scenarios.platform, args.scenarios, [f"--{o}" for o in args.env]).run_spec()

    def finish(folder: Path) -> None:
        if args.statistics_of or Path(args.base).is_dir():
            use_statistics_of(folder, Path(args.statistics_of or args.base))
        note = donors.describe(options, base, funnel)
        atomic_write(folder / FOLDER / MANIFEST_FILE, json.dumps(note, indent=1) + "\n")

    donors.write_donors(
        args.out, chosen, simulator=spec.slot.options, workers=args.num_workers, funnel=funnel,
        description=f"Recoveries by other policies where {base} fails, for Correction.", license=args.license,
        on_trajectory=Progress("replay"), also=finish,
    )  # fmt: skip
    print(donors.funnel_table(funnel))
    print(
        f"\nlerobot-train --config_path={_training_config(args.base)} --policy.path={_checkpoint(args.base)} "
        f"--dataset.repo_id=local/donors --dataset.root={args.out} --output_dir=correction"
    )
    return 0


def _training_config(base: str) -> str:
    """Returns the shipped training configuration of the base's type, which a folder tells."""
    try:
        kind = json.loads((Path(base) / "config.json").read_text()).get("type")
    except (OSError, ValueError):
        kind = None
    return f"policies/train/correction_{kind if kind in ('act', 'pi05', 'smolvla') else '<type>'}.yaml"


def _checkpoint(base: str) -> str:
    """Returns the base as `lerobot-train` takes it; a name in the logs (NAME@HASH) is none."""
    return base if Path(base).is_dir() or "@" not in base else "<checkpoint>"
