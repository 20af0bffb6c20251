"""`roborecover detect fork`."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path

from lerobot_roborecover.cli.old_options import renamed

HELP = (
    "Continue logged trials from some of their steps in several ways, and say what each gains over going on: "
    "recovery gain = P(success | intervene) - P(success | continue)."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("logs", nargs="+", type=Path, help="trial logs of runs with --env.record_actions=true")
    add("--policy", required=True, help="checkpoint that ran the trials: folder or Hub id")
    add("--out", required=True, type=Path, help="folder of the forks' log and page; a rerun goes on there")
    add(
        "--arm", action="append", default=[], metavar="ARM",
        help="what to do at a fork, beside going on: fresh, rollback:K, correction:CHECKPOINT, "
        "policy:CHECKPOINT, human:MODULE:FUNCTION; may be given again (fresh and rollback:30)",
    )  # fmt: skip
    add("--stride", type=int, default=25, help="fork every so many steps, from the handoff on (%(default)s)")
    add("--steps", metavar="STEPS", default="", help="fork at these steps instead, e.g. 0,40,80")
    add(
        "--outcome",
        default="all",
        choices=("all", "failures", "successes"),
        help="which trials (%(default)s)",
    )
    add("--trials", type=int, default=0, help="trials of each scenario, at most (all)")
    add(
        "--repeats",
        type=int,
        default=1,
        help="random streams for each fork, shared by its arms (%(default)s)",
    )
    add(
        "--deterministic", action="store_true",
        help="the policy does the same in every trial: going on is the logged trial, which is not run again "
        "(one in ten is, to check)",
    )  # fmt: skip
    add("--correction-steps", type=int, default=30, help="steps of a correction policy (%(default)s)")
    add("--scenarios", default="", help="scenario set of the trials (default: the one that they name)")
    add("--revision", help="commit, tag or branch of that set on the Hub")
    add(
        "--env", action="append", default=[], metavar="NAME=VALUE",
        help="option of the recovery env type that the rows do not say; may be given again",
    )  # fmt: skip
    add(
        "--policy-option", action="append", default=[], metavar="NAME=VALUE",
        help="option of the policy as it was run, e.g. n_action_steps=10; may be given again",
    )  # fmt: skip
    add(
        "--rename_map", type=json.loads, default={},
        help="the env's observation keys to the policy's, JSON, as it was run",
    )  # fmt: skip
    add("--device", help="of the policies")
    add("--num-workers", type=int, default=0, help="simulators at once (as roborecover eval)")
    add(
        "--max-batch", type=int, default=1,
        help="observations per inference; above 1 a policy's last bits depend on its company (%(default)s)",
    )  # fmt: skip
    renamed(parser, "--outcome", "--of")
    renamed(parser, "--steps", "--at")
    renamed(parser, "--stride", "--every")
    renamed(parser, "--num-workers", "--slots")


def run(args: argparse.Namespace) -> int:
    """Runs the forks, writes the page, prints the gains."""
    from lerobot_roborecover.analysis.pages.fork_gain import PAGE, reproduced_text, write_gains
    from lerobot_roborecover.analysis.stats.fork_gain import fork_gains
    from lerobot_roborecover.analysis.tables import to_text
    from lerobot_roborecover.detection.forks.arms import parse_arm
    from lerobot_roborecover.detection.forks.parents import Choice
    from lerobot_roborecover.detection.forks.run import ForkRequest, run_forks
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.utils.progress import Progress

    try:
        at = tuple(int(step) for step in args.steps.split(",") if step.strip())
    except ValueError:
        raise OptionError(f"--steps={args.steps}: steps, e.g. 0,40,80") from None
    if not isinstance(args.rename_map, dict):
        raise OptionError(f"--rename_map={args.rename_map!r:.80}: a JSON object of observation keys")
    request = ForkRequest(
        args.logs,
        args.policy,
        args.out,
        [parse_arm(text) for text in dict.fromkeys(args.arm or ("fresh", "rollback:30"))],
        Choice(args.outcome, args.trials, args.stride, at),
        args.repeats,
        args.scenarios,
        args.revision,
        args.env,
        args.policy_option,
        args.rename_map,
        correction_steps=args.correction_steps,
        device=args.device,
        slots=args.num_workers,
        max_batch=args.max_batch,
        deterministic=args.deterministic,
    )
    result = run_forks(request, Progress("fork").of)
    for reason, count in result.dropped.most_common():
        print(f"note: {count} trials not forked: {reason}", file=sys.stderr)
    gains = fork_gains(result.rows)
    tables = write_gains(gains, args.out, shlex.join(["roborecover", *sys.argv[1:]]))
    print("\n\n".join(f"{table.title}\n{to_text(table)}" for table in tables[:3]))
    print(f"\n{reproduced_text(gains)}\nlog {result.log}\npage {args.out / PAGE}")
    same, of = gains.reproduced
    if same != of and args.deterministic:
        print(
            f"error: {args.policy} is said to be deterministic, and {of - same} of {of} of its trials end "
            "otherwise on another random stream: what is above is wrong. Leave out --deterministic, and name "
            "another --out",
            file=sys.stderr,
        )
    return 0 if same == of else 1
