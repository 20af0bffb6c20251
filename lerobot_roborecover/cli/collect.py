"""`roborecover curate collect`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot_roborecover.curation.collect.options import CollectOptions

from lerobot_roborecover.cli.old_options import renamed
from lerobot_roborecover.cli.workplace import add_workplace, workplace
from lerobot_roborecover.datasets.licenses import license_argument

HELP = "Roll out a policy or a scripted controller from initial states, and keep its failures as candidates."


def build_parser() -> argparse.ArgumentParser:
    """The command's own parser; `--policy.*` and `--env.*` are LeRobot's."""
    parser = argparse.ArgumentParser(
        prog="roborecover curate collect",
        description=HELP,
        epilog="--policy.path=CHECKPOINT and any --policy.OPTION=VALUE, --env.type=roborecover_libero and "
        "any --env.OPTION=VALUE are those of roborecover eval. A rerun goes on where it was stopped.",
    )
    add_arguments(parser)
    return parser


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's own arguments."""
    add = parser.add_argument
    add("--expert", default="", metavar="NAME", help="scripted controller instead of a policy; ? lists them")
    add("--name", default="", help="recorded name of the controller (checkpoint, or expert)")
    add("--out", type=Path, metavar="DIR", help="folder of the candidate dataset; needed to collect")
    add("--work", type=Path, metavar="DIR", help="folder of the rollouts, kept (OUT.work)")
    add(
        "--task", action="append", default=[], metavar="PATTERN",
        help="suite, task, or suite/task, with * and ?; repeat it for several",
    )  # fmt: skip
    add("--seeds", default="", help="start from these seeds, e.g. 0-29,40")
    add("--init-states", default="", help="start from these of LIBERO's init states, e.g. 0,3,5-9")
    add("--draw", type=int, default=0, metavar="N", help="draw N starts of each task instead")
    add("--seed", type=int, default=7, help="of every draw: starts, noise, perturbation (%(default)s)")
    add("--reset-seed", type=int, default=7, help="of LIBERO's resets (%(default)s, the paper's)")
    add("--trials", type=int, default=1, help="rollouts from each start (%(default)s)")
    add(
        "--horizon", type=int, default=0, metavar="STEPS",
        help="budget of each task, of the rollouts and of what is built from them (the platform's)",
    )  # fmt: skip
    add("--perturb", action="store_true", help="add Uniform(-1, 1) to the translations of early actions")
    add("--perturb-steps", type=int, default=150, metavar="N", help="how many steps (%(default)s)")
    add(
        "--min-displacement", type=float, default=0.0, metavar="MM",
        help="with --perturb: keep only rollouts in which an object ends at least so far from its path "
        "without disturbance, or tipped; runs each undisturbed, too",
    )  # fmt: skip
    add("--frames", default="256", metavar="none|SIZE", help="side of the pictures, pixels (%(default)s)")
    add(
        "--frame-stride", type=int, default=1, metavar="N",
        help="render every Nth step alone, where that is slow; it stands until the next (%(default)s)",
    )  # fmt: skip
    add("--no-exclude", action="append", default=[], metavar="RULE", help="do not ask this exclusion rule")
    add("--exclude-only", action="append", default=[], metavar="RULE", help="ask this exclusion rule alone")
    add("--num-workers", type=int, default=0, help="simulators at once (one per core, or CPU of a cluster)")
    add_workplace(parser, policies=True)
    add("--max-batch", type=int, default=1, help="slots that a policy is asked for at once (%(default)s)")
    add("--device", help="of the policy")
    add("--rename_map", type=json.loads, default={}, help="the env's observation keys to the policy's, JSON")
    add("--part-size", type=int, default=20, help="candidates written at a time (%(default)s)")
    add(
        "--watchdog",
        type=float,
        default=600.0,
        metavar="S",
        help="longest a simulator may be silent (%(default)s)",
    )
    add("--retry-errors", action="store_true", help="roll out again what broke in an earlier run")
    add("--description", default="", help="of the dataset")
    add(
        "--license",
        type=license_argument,
        help="licence by the Hub's identifier, of the dataset; none is assumed",
    )
    add("--dry-run", action="store_true", help="list the rollouts, and run none")
    renamed(parser, "--frame-stride", "--film-every")
    renamed(parser, "--min-displacement", "--scene-touched")
    renamed(parser, "--num-workers", "--slots")


def pass_through(argv: Sequence[str]) -> int:
    """Parses, collects, and prints the table."""
    from lerobot_roborecover.curation.collect.collection import collect, describe, plan
    from lerobot_roborecover.utils.text import pluralize

    parser = build_parser()
    args, rest = parser.parse_known_args(pairs(argv))
    if args.expert == "?":
        from lerobot_roborecover.curation.collect.experts import list_experts

        kinds = [
            w.partition("=")[2].removeprefix("roborecover_") for w in rest if w.startswith("--env.type=")
        ]
        print(list_experts(kinds[-1] if kinds else ""))
        return 0
    if args.out is None:
        parser.error("the following arguments are required: --out")
    chosen = options(parser, args, rest)
    if args.dry_run:
        units = plan(chosen, lambda line: print(line, file=sys.stderr))
        for unit in units:
            print(f"{unit.id}  {unit.task.suite}/{unit.task.name}")
        print(f"{pluralize(len(units), 'rollout')}; dry run: nothing was run")
        return 0
    collected = collect(chosen, lambda line: print(line, file=sys.stderr))
    print(describe(collected))
    return 0 if collected.out is not None else 1


def pairs(argv: Sequence[str]) -> list[str]:
    """`--policy.path X` and `--env.type X` as `--policy.path=X`."""
    joined: list[str] = []
    for word in argv:
        bare = joined and joined[-1].startswith(("--policy.", "--env.")) and "=" not in joined[-1]
        if bare and not word.startswith("--"):
            joined[-1] = f"{joined[-1]}={word}"
        else:
            joined.append(word)
    return joined


def options(parser: argparse.ArgumentParser, args: argparse.Namespace, rest: list[str]) -> CollectOptions:
    """What to collect, from parsed arguments and those that are LeRobot's."""
    from lerobot_roborecover.curation.collect.judge import FilterConfig
    from lerobot_roborecover.curation.collect.options import CollectOptions, parse_side
    from lerobot_roborecover.curation.collect.starts import parse_numbers
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.platforms import platform_named, platform_names
    from lerobot_roborecover.platforms.registry import env_type_of, platform_of
    from lerobot_roborecover.platforms.starts import Starts

    policy, kind, env, policy_options = "", "", [], []
    for word in rest:
        name, _, value = word.partition("=")
        if name == "--policy.path":
            policy = value
        elif name == "--env.type":
            kind = platform_of(value)
        elif name.startswith("--policy."):
            policy_options.append(word.removeprefix("--policy."))
        elif name.startswith("--env."):
            env.append(word.removeprefix("--env."))
        else:
            parser.error(f"unrecognized argument: {word}")
    if kind not in platform_names():
        known = ", ".join(env_type_of(name) for name in platform_names())
        raise OptionError(f"--env.type={kind or 'none'}: give one of {known}")
    side = parse_side(args.frames)
    if not isinstance(args.rename_map, dict):
        raise OptionError(f"--rename_map={args.rename_map!r:.80}: a JSON object of observation keys")
    seeds = parse_numbers(args.seeds, "--seeds") if args.seeds else ()
    states = parse_numbers(args.init_states, "--init-states") if args.init_states else ()
    return CollectOptions(
        platform=platform_named(kind).resolve(env).name,
        out=args.out,
        starts=Starts(seeds, states, args.draw, args.seed, args.trials, args.reset_seed),
        tasks=tuple(args.task),
        policy=policy,
        expert=args.expert,
        name=args.name,
        work=args.work,
        env=tuple(env),
        policy_options=tuple(policy_options),
        rename_map=args.rename_map,
        device=args.device,
        perturb=args.perturb,
        perturbed_steps=args.perturb_steps,
        judging=FilterConfig(tuple(args.no_exclude), tuple(args.exclude_only), args.min_displacement),
        seed=args.seed,
        frames=side,
        workplace=workplace(args),
        slots=args.num_workers,
        replicas=args.replicas,
        max_batch=args.max_batch,
        horizon=args.horizon,
        frame_stride=args.frame_stride,
        part_size=args.part_size,
        watchdog_s=args.watchdog,
        retry_errors=args.retry_errors,
        description=args.description,
        license=args.license,
    )
