"""`roborecover detect evaluate`: detectors side by side on a policy's own trials."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from lerobot_roborecover.cli.old_options import renamed

HELP = (
    "Compare failure detectors side by side on a policy's own trials: ranking, delays, false alarms a "
    "minute, calibration, conformal thresholds, cost. With intervals over scenarios."
)
NEEDED = ("detector", "scenarios", "policy")
"""Options of a comparison, which a report of an earlier one (`--scores`) does without."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_detector_arguments(parser, workers="--num-workers")
    renamed(parser, "--num-workers", "--workers")
    add = parser.add_argument
    add("--out", type=Path, default=Path("outputs/detectors"), help="folder of the report (%(default)s)")
    add("--device", help="where the policy and the detectors run")
    add("--base-model", help="base of a Qwen3-VL monitor, where its checkpoint names another place")
    add(
        "--on-training-scenarios", action="store_true",
        help="compare also on scenarios that a monitor was trained on: says nothing about others",
    )  # fmt: skip
    add("--seed", type=int, default=0, help="of the scenarios' halves in the frame strips (%(default)s)")
    add("--level", type=float, default=0.95, help="confidence level (%(default)s)")


def add_detector_arguments(parser: argparse._ActionsContainer, *, workers: str) -> None:
    """Adds the arguments that concern detectors and trials alone.

    Args:
        parser: of the command.
        workers: the option that says how many processes replay and render.
    """
    add = parser.add_argument
    add(
        "--detector", action="append", metavar="[NAME=]WHAT[,OPTION=VALUE...]",
        help="a checkpoint of a monitor, of a saved detector or of a LeRobot reward model; or "
        "chunk_disagreement, constant, elapsed, no_progress, oracle, policy_features, recovery_gain, "
        "state_distance; may be given again",
    )  # fmt: skip
    add(
        "--scores", type=Path, metavar="DIR",
        help="run nothing: report the scores in the --out of an earlier comparison",
    )  # fmt: skip
    add("--scenarios", help="scenario set: folder, Hub id or shipped name")
    add("--policy", metavar="CHECKPOINT", help="who acts in the trials, and is watched")
    add("--scenarios-revision", metavar="REVISION", help="commit, tag or branch of the set on the Hub")
    add("--split", default="test", help="scenarios that are measured on (%(default)s)")
    add(
        "--fit-split", default="train",
        help="scenarios whose trials policy_features and state_distance are fitted to (%(default)s)",
    )  # fmt: skip
    add("--select", default="", help="which scenarios, e.g. 'suite=hard; source=natural'")
    add("--fit-select", help="the same of --fit-split alone (as --select)")
    add("--trials", type=int, default=1, help="of each scenario, from each start (%(default)s)")
    add("--run-seed", type=int, default=1000, help="of the trials (%(default)s)")
    add(
        "--training-data", type=Path, metavar="DIR",
        help="LeRobotDataset that the policy was trained on, for state_distance (successful clean rollouts)",
    )  # fmt: skip
    add(
        "--forks", type=Path, metavar="LOG",
        help="log of `roborecover detect fork` on trials of the policy, for recovery_gain",
    )  # fmt: skip
    add(
        "--alpha", type=float, default=0.1,
        help="chance of a false alarm in a clean rollout that conformal thresholds allow (%(default)s)",
    )  # fmt: skip
    add(
        "--against", action="append", default=[], metavar="NAME",
        help="test pairs with this detector alone; may be given again (all pairs)",
    )  # fmt: skip
    add("--frame-strips", type=int, default=3, help="trials shown frame by frame; 0: none (%(default)s)")
    renamed(parser, "--frame-strips", "--films")
    add("--work", type=Path, help="folder of trials and observations, kept between runs (OUT.work)")
    add(workers, dest="workers", type=int, default=1, help="processes that replay and render (%(default)s)")
    add(
        "--env", action="append", default=[], metavar="NAME=VALUE",
        help="option of the recovery env type, e.g. obs_type=state; may be given again",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Runs the trials, computes, writes and prints; or reports an earlier comparison."""
    from lerobot_roborecover.policies.detectors.monitor.errors import MonitorError

    if args.scores:
        refuse_with_scores(args, NEEDED)
        return report_scores(args)
    missing = [name for name in NEEDED if not getattr(args, name)]
    if missing:
        raise MonitorError(
            f"--{missing[0]} is missing. Give --detector, --scenarios and --policy to compare detectors; or "
            "--scores, the --out of an earlier comparison, to report it again"
        )
    return compare(args)


def refuse_with_scores(args: argparse.Namespace, names: tuple[str, ...]) -> None:
    """Refuses options that a report of a finished comparison does not take.

    Raises:
        MonitorError: one of them is given.
    """
    from lerobot_roborecover.policies.detectors.monitor.errors import MonitorError

    clash = [name for name in names if getattr(args, name)]
    if clash:
        raise MonitorError(
            f"--{clash[0]} does not belong to --scores, which reports a finished comparison. Leave out one"
        )


def compare(args: argparse.Namespace) -> int:
    """Compares detectors on a policy's trials."""
    from lerobot_roborecover._version import __version__
    from lerobot_roborecover.analysis.pages.detection import (
        DETECTION_FILES,
        detection_text,
        write_detection_report,
    )
    from lerobot_roborecover.detection.request import DetectionRequest, compare_detectors
    from lerobot_roborecover.detection.strips import choose_trials, frame_strips
    from lerobot_roborecover.detection.trials import TrialSource
    from lerobot_roborecover.utils.outputs import check_page
    from lerobot_roborecover.utils.progress import Progress

    check_page(args.out, DETECTION_FILES)
    source = TrialSource(
        scenarios=args.scenarios,
        policy=args.policy,
        work=args.work or args.out.with_name(f"{args.out.name}.work"),
        revision=args.scenarios_revision,
        select=args.select,
        env=args.env,
        trials=args.trials,
        run_seed=args.run_seed,
        device=args.device,
        workers=args.workers,
    )
    request = DetectionRequest(
        detectors=args.detector,
        source=source,
        split=args.split,
        fit_split=args.fit_split,
        fit_select=args.fit_select,
        training_data=args.training_data,
        forks=args.forks,
        alpha=args.alpha,
        on_training_scenarios=args.on_training_scenarios,
        device=args.device,
        base_model=args.base_model,
        level=args.level,
        seed=args.seed,
        against=args.against,
    )
    found = compare_detectors(request, args.out, Progress("trial").of)
    strips, problem = frame_strips(found.trials, choose_trials(found.trials, args.frame_strips))
    remarks = [*found.remarks, *([f"no pictures: {problem}"] if problem else [])]
    remarks += [f"left out {n}: {reason}" for reason, n in found.dropped.most_common()]
    about = {
        "policy": args.policy,
        "scenarios": f"{args.scenarios}, split {args.split}",
        "trials": f"{len(found.trials)}, {args.trials} of each scenario from each start",
        "false-alarm rate": f"{args.alpha:g} a clean rollout",
        "package": __version__,
        "command": shlex.join(["roborecover", *sys.argv[1:]]),
        **({"remarks": "; ".join(remarks)} if remarks else {}),
    }
    page = write_detection_report(
        args.out, found.measured, found.scored, strips, alpha=args.alpha, level=args.level, seed=args.seed,
        about=about, pairs=found.pairs, against=args.against,
    )  # fmt: skip
    print(detection_text(found.measured, found.pairs, args.alpha, args.level))
    for remark in remarks:
        print(f"\nnote: {remark}", file=sys.stderr)
    for m in found.measured:
        if m.saved:
            print(f"use it: --policy.monitor.path={m.saved}")
    print(f"\npage {page}\nnumbers {args.out / 'detectors.json'}")
    return 0


def report_scores(args: argparse.Namespace) -> int:
    """Reports a finished comparison of detectors again."""
    from lerobot_roborecover.analysis.pages.detection import (
        DETECTION_FILES,
        detection_text,
        write_detection_report,
    )
    from lerobot_roborecover.analysis.stored_comparison import read_comparison
    from lerobot_roborecover.utils.outputs import check_page

    check_page(args.out, DETECTION_FILES)
    found = read_comparison(args.scores)
    page = write_detection_report(
        args.out, found.measured, found.scored, (), alpha=found.alpha, level=found.level, seed=found.seed,
        about=found.about, pairs=found.pairs, against=found.against,
    )  # fmt: skip
    print(detection_text(found.measured, found.pairs, found.alpha, found.level))
    print(f"\npage {page}")
    return 0
