"""`roborecover eval-monitor`: old name of `detect evaluate` and `detect evaluate-frames`, for one release."""

from __future__ import annotations

import argparse
from pathlib import Path

from lerobot_roborecover.cli import detect_evaluate, detect_evaluate_frames

HELP = (
    "Measure a trained monitor on held-out frames (--monitor, --data): accuracy, precision, recall, F1, "
    "Macro-F1, FPR, confusion counts, curves, trigger rate and detection delay. Or compare detectors side by "
    "side on a policy's own trials (--detector, --scenarios, --policy): ranking, delays, false alarms "
    "a minute, calibration, conformal thresholds, cost. With intervals over scenarios."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of both commands."""
    detect_evaluate_frames.add_frame_arguments(parser, required=False)
    add = parser.add_argument
    add("--out", type=Path, default=Path("outputs/monitor"), help="folder of the report (%(default)s)")
    add("--device", help="where the monitor, the policy and the detectors run")
    add("--base-model", help="base of the Qwen3-VL monitor, where its checkpoint names another place")
    add(
        "--on-training-scenarios", action="store_true",
        help="measure also on scenarios that the monitor was trained on: says nothing about others",
    )  # fmt: skip
    add("--draws", type=int, default=10_000, help="without effect: the intervals need no draws")
    add("--seed", type=int, default=0, help="without effect, likewise")
    add("--level", type=float, default=0.95, help="confidence level (%(default)s)")
    side_by_side = parser.add_argument_group("detectors side by side")
    # Here --num-workers are those that read frames.
    detect_evaluate.add_detector_arguments(side_by_side, workers="--workers")


def run(args: argparse.Namespace) -> int:
    """Runs the one of the two commands that the options belong to."""
    from lerobot_roborecover.policies.detectors.monitor.errors import MonitorError

    frames, side = ("monitor", "data"), detect_evaluate.NEEDED
    if args.scores:
        detect_evaluate.refuse_with_scores(args, (*frames, *side))
        return detect_evaluate.report_scores(args)
    wanted, others = (side, frames) if args.detector else (frames, side)
    missing = [name for name in wanted if not getattr(args, name)]
    clash = [name for name in others if getattr(args, name)]
    if missing or clash:
        what = f"--{missing[0]} is missing" if missing else f"--{clash[0]} does not belong to --{wanted[0]}"
        raise MonitorError(
            f"{what}. Give --monitor and --data to measure a monitor on frames; or --detector, --scenarios "
            "and --policy to compare detectors on a policy's trials"
        )
    return detect_evaluate.compare(args) if args.detector else detect_evaluate_frames.run(args)
