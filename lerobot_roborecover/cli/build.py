"""`roborecover curate build`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.determinism import pin_policy_kernels
from lerobot_roborecover.utils.options import option

HELP = (
    "Build a scenario dataset from one YAML file: collect, annotate, agree, screen, validate, split, render."
)


@dataclass(frozen=True, kw_only=True)
class BuildOptions:
    """What to build, and which stages."""

    config: Path = option(positional=True)
    """The YAML file, e.g. policies/build/metaworld.yaml."""
    first: str = option("", name="from", metavar="STAGE")
    """Run this stage and all after it, changed or not: collect, join, annotate, agree, screen, validate,
    split, render, publish."""
    until: str = option("", metavar="STAGE")
    """Stop after this stage."""
    dry_run: bool = False
    """Say what would run, and run nothing."""


OPTIONS = BuildOptions


def run(options: BuildOptions) -> int:
    """Builds, writes the summary, and prints the funnel."""
    pin_policy_kernels()  # outcomes of these trials are compared with those of a study
    from lerobot_roborecover.curation.pipeline.check import check_build
    from lerobot_roborecover.curation.pipeline.config import read_config
    from lerobot_roborecover.curation.pipeline.stages import AwaitingAnnotations, Pipeline
    from lerobot_roborecover.curation.pipeline.summary import write_summary
    from lerobot_roborecover.curation.pipeline.work import StageRunners
    from lerobot_roborecover.curation.render import publish_next
    from lerobot_roborecover.utils.text import next_command

    config = read_config(options.config)
    if problems := check_build(config):
        listed = "\n".join(f"  - {problem}" for problem in problems)
        print(f"{options.config} cannot be built, and nothing was run:\n{listed}", file=sys.stderr)
        if not options.dry_run:
            return 2
    chain = Pipeline(config, StageRunners(), lambda line: print(line, flush=True))
    waiting = ""
    try:
        done = chain.build(options.first, options.until, options.dry_run)
    except AwaitingAnnotations as err:
        waiting, done = str(err), []
    if options.dry_run:
        return 2 if problems else 0
    if text := write_summary(chain.places, options.config, done):
        print(f"\n{text}\n\nsummary in {chain.places.summary}")
    if waiting:
        print(f"\nstopped: {waiting}")
        return 1
    if config.publish is None and not options.until:
        print("\n" + next_command(publish_next(chain.places.result), "to publish"))
    return 0
