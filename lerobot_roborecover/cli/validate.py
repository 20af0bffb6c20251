"""`roborecover curate validate`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.cli.old_options import renamed
from lerobot_roborecover.cli.workplace import add_workplace, workplace

if TYPE_CHECKING:
    from lerobot_roborecover.curation.validate.request import ValidationRequest

HELP = (
    "Replay screening runs of every scenario and keep the scenarios whose recovery point comes back as it "
    "was recorded."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("dataset", type=Path, help="folder of a screened scenario dataset")
    add("--trials-folder", type=Path, metavar="DIR", help="where screen kept the trials")
    add(
        "--states", action="store_true",
        help="only replay the prefixes of a set that was made elsewhere or by an earlier version, and write "
        "the hashes of their states: no scenario is judged, and nothing else changes",
    )  # fmt: skip
    add(
        "--candidates", action="append", default=[], type=Path, metavar="DIR",
        help="candidate dataset that the scenarios were made from: original poses and frames; may be given "
        "again",
    )  # fmt: skip
    add("--out", required=True, type=Path, help="folder of the new dataset")
    add("--runs", type=int, default=3, help="screening runs drawn of each scenario (%(default)s)")
    add("--seed", type=int, default=42, help="of the draw (%(default)s)")
    add("--tolerance-mm", type=float, default=2.0, help="of end effectors and objects (%(default)s)")
    add("--min-ssim", type=float, default=0.99, help="the mean SSIM must exceed it (%(default)s)")
    add("--no-frames", action="store_true", help="compare states alone; the provenance says so")
    add("--no-outcomes", action="store_true", help="do not compare how the screening runs end")
    add(
        "--env", action="append", default=[], metavar="KEY=VALUE",
        help="option of the recovery env type, as the originals were rendered; may be given again",
    )  # fmt: skip
    add("--reject", action="append", default=[], metavar="ID", help="on looking at the sheets; repeat it")
    add("--reason", default="", help="why, for every --reject")
    add(
        "--rejects", type=Path, metavar="FILE",
        help="the same as a file: a line each, the id, a blank, the reason",
    )  # fmt: skip
    add("--accept", action="append", default=[], metavar="ID", help="take a rejection back")
    add("--by", default="a person", metavar="NAME", help="who looked (%(default)s)")
    add("--num-workers", type=int, default=0, help="processes that replay (1, or every CPU of a cluster)")
    add_workplace(parser, policies=False)
    add("--limit-s", type=float, default=900, help="for one scenario's replays (%(default)s)")
    add("--work", type=Path, metavar="DIR", help="replays and sheets, kept between runs (OUT.replays)")
    renamed(parser, "--num-workers", "--workers")


def run(args: argparse.Namespace) -> int:
    """Validates, and prints the distribution and the funnel."""
    from lerobot_roborecover.curation.validate.dataset import describe, validate_dataset
    from lerobot_roborecover.utils.progress import Progress

    if args.states:
        return _states(args)
    asked = request(args)
    print(describe(asked, validate_dataset(asked, Progress("replay"))))
    return 0


def request(args: argparse.Namespace) -> ValidationRequest:
    """What to validate, from parsed arguments."""
    from lerobot_roborecover.curation.validate.request import ValidationRequest, read_rejects
    from lerobot_roborecover.curation.validate.validation import ValidationRule
    from lerobot_roborecover.errors import OptionError

    if args.trials_folder is None:
        raise OptionError(
            "--trials-folder is missing: name the folder of trials that roborecover curate screen kept"
        )
    return ValidationRequest(
        dataset=args.dataset,
        trials_folder=args.trials_folder,
        out=args.out,
        candidates=args.candidates,
        rule=ValidationRule(
            args.runs, args.seed, args.tolerance_mm, args.min_ssim, not args.no_frames, not args.no_outcomes
        ),
        env=args.env,
        rejects=read_rejects(args.rejects) | dict.fromkeys(args.reject, args.reason),
        accepts=args.accept,
        by=args.by,
        workers=args.num_workers,
        workplace=workplace(args),
        limit_s=args.limit_s,
        work=args.work,
    )


def _states(args: argparse.Namespace) -> int:
    from lerobot_roborecover.curation.validate.states import write_states
    from lerobot_roborecover.utils.progress import Progress

    found = write_states(args.dataset, args.out, args.num_workers, Progress("replay"), workplace(args))
    print(
        f"{found.scenarios} states, each replayed twice and identical; {found.filled} had no hash; largest "
        f"distance from the recording {found.largest_mm:g} mm\n{args.out}"
    )
    return 0
