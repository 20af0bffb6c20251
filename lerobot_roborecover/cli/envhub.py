"""`roborecover dataset envhub`."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "Write an EnvHub repository (env.py and a card) that offers a scenario set as an environment."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("scenarios", help="scenario set: Hub id (org/name), or the name of a shipped one")
    add("--revision", help="commit, tag or branch of the set; the commit that is read is what env.py names")
    add("--split", help="this split only, e.g. test")
    add("--repo-id", required=True, metavar="ORG/NAME", help="what the environment will be called on the Hub")
    add("--out", type=Path, required=True, help="folder of the repository's files")


def run(args: argparse.Namespace) -> int:
    """Writes the files and says how to upload them."""
    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.evaluation.envhub_files import write_envhub

    found = load_scenarios(args.scenarios, revision=args.revision, split=args.split)
    for path in write_envhub(found, args.out, args.repo_id, args.split):
        print(f"wrote     {path}")
    print(f"offer it  hf upload {args.repo_id} {args.out}")
    print(f'use it    make_env(HubEnvConfig(hub_path="{args.repo_id}"), trust_remote_code=True)')
    return 0
