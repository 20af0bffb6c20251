"""`roborecover curate collect`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

from lerobot_roborecover.cli.arguments import Parser, add_options, read_options
from lerobot_roborecover.curation.collect.options import CollectOptions
from lerobot_roborecover.evaluation.early_checks import ENV, CommandLine, ConfigSource, join_values

HELP = "Roll out a policy or a scripted controller from initial states, and keep its failures as candidates."


@dataclass(frozen=True, kw_only=True)
class CollectCommand(CollectOptions):
    """What to collect, and whether to."""

    dry_run: bool = False
    """List the rollouts, and run none."""


OPTIONS = CollectCommand
LEROBOTS = ConfigSource("roborecover curate collect", required=(ENV,))
"""Options that LeRobot's parser reads."""


class CollectParser(Parser):
    """The command's own parser; `--policy.*` and `--env.*` are LeRobot's."""

    passes = ("--policy.", "--env.", "--env")


def build_parser() -> CollectParser:
    """Returns the command's own parser."""
    parser = CollectParser(
        prog="roborecover curate collect",
        description=HELP,
        epilog="--policy.path=CHECKPOINT and any --policy.OPTION=VALUE, --env.type=roborecover_libero and "
        "any --env.OPTION=VALUE are those of roborecover eval. A rerun goes on where it was stopped.",
    )
    add_options(parser, CollectCommand)
    return parser


def pass_through(argv: Sequence[str]) -> int:
    """Parses, collects, and prints the table."""
    from lerobot_roborecover.curation.collect.collection import collect, describe, plan
    from lerobot_roborecover.utils.text import pluralize

    parser = build_parser()
    args, rest = parser.parse_known_args(pairs(argv))
    both = args.expert and any(word.startswith("--policy.path=") for word in rest)
    if args.expert != "?" and not both:  # both are refused with the other options
        CommandLine(LEROBOTS, rest).check()
    if args.expert == "?":
        from lerobot_roborecover.curation.collect.experts import list_experts

        kinds = [
            w.partition("=")[2].removeprefix("roborecover_") for w in rest if w.startswith("--env.type=")
        ]
        print(list_experts(kinds[-1] if kinds else ""))
        return 0
    if args.out is None:
        parser.error("the following arguments are required: --out")
    chosen = options(parser, read_options(CollectCommand, args), rest)
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
    """`--policy.path X` and `--env.type X` as `--policy.path=X`, and `--env X` as `--env.type=X`."""
    words = join_values(argv, CollectParser.passes)
    return [f"--env.type={w.removeprefix('--env=')}" if w.startswith("--env=") else w for w in words]


def options(parser: Parser, given: CollectOptions, rest: list[str]) -> CollectOptions:
    """Returns what to collect, with the policy and the environment that LeRobot's options name.

    Args:
        parser: refuses what is neither.
        given: the command's own options.
        rest: the words that are LeRobot's.
    """
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.platforms import platform_named, platform_names
    from lerobot_roborecover.platforms.registry import env_type_of, platform_of

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
    platform = platform_named(kind).resolve(env).name
    return replace(
        given, platform=platform, policy=policy, env=tuple(env), policy_options=tuple(policy_options)
    )
