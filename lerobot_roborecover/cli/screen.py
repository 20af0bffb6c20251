"""`roborecover curate screen`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.cli.old_options import renamed
from lerobot_roborecover.cli.workplace import add_workplace, workplace
from lerobot_roborecover.utils.determinism import pin_policy_kernels

if TYPE_CHECKING:
    from lerobot_roborecover.curation.screen.dataset import ScreenRequest

HELP = (
    "Run screening policies from every scenario's recovery point and keep the scenarios of intermediate "
    "difficulty."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("dataset", help="scenario set: folder, Hub id or shipped name")
    add(
        "--policy", action="append", default=[], metavar="[NAME=]CHECKPOINT",
        help="a screening policy, folder or Hub id; give it again for each (the paper has four)",
    )  # fmt: skip
    add("--out", required=True, type=Path, help="folder of the new dataset; new or empty")
    add("--trials", type=int, default=5, help="of each policy on each scenario (%(default)s)")
    add(
        "--keep", nargs=2, default=["0.1", "0.9"], metavar=("FEWEST", "MOST"),
        help="successes of all policies together that stay: two counts, or two shares of all trials (0.1 "
        "0.9: 2 to 18 of 20)",
    )  # fmt: skip
    add(
        "--deterministic", action="append", default=[], metavar="NAME",
        help="this policy does the same in every trial: run one of each scenario, and count it as all; may "
        "be given again",
    )  # fmt: skip
    add(
        "--max-invalid", type=int, default=0, metavar="N",
        help="invalid trials that a scenario may have; they count as failures (%(default)s)",
    )  # fmt: skip
    add(
        "--early-stop", action="store_true",
        help="stop trying a scenario once no further trial could change whether it stays (after three, which "
        "validation replays): the same scenarios stay after fewer trials; deterministic policies come first",
    )  # fmt: skip
    add("--trials-folder", type=Path, metavar="DIR", help="trials, kept between runs (OUT.trials)")
    add(
        "--trials-from", action="append", default=[], type=Path, metavar="DIR",
        help="a trials folder of another machine, to be taken over first; may be given again",
    )  # fmt: skip
    add("--shard", default="", metavar="K/N", help="run this part's trials only, and write no dataset")
    add(
        "--retry", default="", metavar="OUTCOMES",
        help="run invalid trials of these outcomes again, e.g. policy_error,timeout",
    )  # fmt: skip
    add("--run-seed", type=int, default=1000, help="of the trials (%(default)s)")
    add("--device", help="of the policies")
    add("--num-workers", type=int, default=0, help="simulators at once (one per core, or CPU of a cluster)")
    add_workplace(parser, policies=True)
    add(
        "--max-batch", type=int, default=1,
        help="observations per inference, at most (%(default)s); above 1 the last bits of actions, and with "
        "them some outcomes, depend on the other observations",
    )  # fmt: skip
    add(
        "--env", action="append", default=[], metavar="[NAME:]KEY=VALUE",
        help="option of the recovery env type, for one policy where its name stands before it; may be given "
        "again",
    )  # fmt: skip
    add(
        "--policy-option", action="append", default=[], metavar="[NAME:]KEY=VALUE",
        help="the same of the policy's config, e.g. act:n_action_steps=10",
    )  # fmt: skip
    add(
        "--rename-map", action="append", default=[], metavar="[NAME:]JSON",
        help="the env's observation keys to the policy's, as --rename_map of lerobot-eval",
    )  # fmt: skip
    renamed(parser, "--early-stop", "--curtail")
    renamed(parser, "--num-workers", "--slots")


def run(args: argparse.Namespace) -> int:
    """Screens, and prints the tables and the funnel."""
    pin_policy_kernels()  # outcomes of these trials are compared with those of a study
    from lerobot_roborecover.curation.screen.dataset import describe, screen_dataset
    from lerobot_roborecover.utils.progress import Progress

    asked = request(args)
    print(describe(asked, screen_dataset(asked, Progress("trial").of)))
    return 0


def request(args: argparse.Namespace) -> ScreenRequest:
    """What to screen, from parsed arguments."""
    from lerobot_roborecover.curation.screen.dataset import ScreenRequest
    from lerobot_roborecover.curation.screen.runs import parse_policies
    from lerobot_roborecover.curation.screen.screening import ScreenRule

    policies, env = parse_policies(args.policy, args.policy_option, args.env, args.rename_map)
    return ScreenRequest(
        dataset=args.dataset,
        policies=policies,
        out=args.out,
        trials_folder=args.trials_folder,
        rule=ScreenRule(args.trials, tuple(args.keep), args.max_invalid, args.early_stop),
        deterministic=args.deterministic,
        run_seed=args.run_seed,
        env=env,
        trials_from=args.trials_from,
        shard=args.shard,
        retry=[o for o in args.retry.split(",") if o],
        device=args.device,
        slots=args.num_workers,
        max_batch=args.max_batch,
        workplace=workplace(args),
        replicas=args.replicas,
    )
