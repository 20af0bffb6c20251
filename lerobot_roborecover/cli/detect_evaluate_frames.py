"""`roborecover detect evaluate-frames`: a trained monitor on labelled frames."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

HELP = (
    "Measure a trained monitor on held-out labelled frames: accuracy, precision, recall, F1, Macro-F1, FPR, "
    "confusion counts, curves, trigger rate and detection delay. With intervals over scenarios."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_frame_arguments(parser, required=True)
    add = parser.add_argument
    add("--out", type=Path, default=Path("outputs/monitor"), help="folder of the report (%(default)s)")
    add("--device", help="where the monitor runs")
    add("--base-model", help="base of the Qwen3-VL monitor, where its checkpoint names another place")
    add(
        "--on-training-scenarios", action="store_true",
        help="measure also on scenarios that the monitor was trained on: says nothing about others",
    )  # fmt: skip
    add("--level", type=float, default=0.95, help="confidence level (%(default)s)")


def add_frame_arguments(parser: argparse._ActionsContainer, *, required: bool) -> None:
    """Adds the arguments that concern a monitor and its frames alone.

    Args:
        parser: of the command.
        required: whether the monitor and the frames have to be named.
    """
    add = parser.add_argument
    add("--monitor", required=required, help="checkpoint: folder or Hub id")
    add("--revision", help="commit, tag or branch of a Hub id")
    add(
        "--data", action="append", required=required, metavar="[NAME=]DIR",
        help="frames of `roborecover detect data`; may be given again",
    )  # fmt: skip
    add("--threshold", type=float, help="decide by score > THRESHOLD instead of the monitor's own answer")
    add(
        "--choose-threshold", metavar="RULE",
        help="choose it on the first --data: macro_f1, f1, accuracy, youden, or fpr=0.05",
    )  # fmt: skip
    add("--num-workers", type=int, default=0, help="processes that read frames (%(default)s)")


def run(args: argparse.Namespace) -> int:
    """Judges the frames, computes, writes and prints."""
    from lerobot_roborecover._version import __version__
    from lerobot_roborecover.analysis.named_path import split_named
    from lerobot_roborecover.analysis.pages.monitor import (
        MONITOR_FILES,
        Measured,
        summary_text,
        write_monitor_report,
    )
    from lerobot_roborecover.analysis.stats.monitor_curves import choose_threshold
    from lerobot_roborecover.analysis.stats.monitor_report import monitor_report
    from lerobot_roborecover.detection.data.judging import judge_dataset
    from lerobot_roborecover.policies.detectors.interface import TrainedMonitor
    from lerobot_roborecover.policies.detectors.loading import load_monitor
    from lerobot_roborecover.policies.detectors.monitor.errors import MonitorError
    from lerobot_roborecover.utils.outputs import check_page
    from lerobot_roborecover.utils.progress import Progress

    check_page(args.out, MONITOR_FILES)
    if args.threshold is not None and args.choose_threshold:
        raise MonitorError("--threshold and --choose-threshold: give one of them")
    if args.threshold is not None and not 0 < args.threshold < 1:
        raise MonitorError(f"--threshold={args.threshold}: must be above 0 and below 1")
    overrides = {"base_model": args.base_model} if args.base_model else {}
    monitor = load_monitor(args.monitor, args.device, args.revision, **overrides)
    if not isinstance(monitor, TrainedMonitor):
        raise MonitorError(
            f"{args.monitor} has no record of what it was trained on, which is measured against"
        )
    judged = []
    for text in args.data:
        name, rest = split_named(text)
        frames, _ = judge_dataset(
            monitor,
            Path(rest),
            num_workers=args.num_workers,
            on_training_scenarios=args.on_training_scenarios,
            on_batch=Progress("frame"),
        )
        judged.append((name or Path(rest).name, frames))
    if len({name for name, _ in judged}) < len(judged):
        raise MonitorError(f"two datasets have one name: {[n for n, _ in judged]}; write --data NAME=DIR")
    threshold = args.threshold
    if args.choose_threshold:
        try:
            threshold = choose_threshold(judged[0][1], args.choose_threshold)
        except ValueError as err:
            raise MonitorError(f"--choose-threshold={args.choose_threshold}: {err}") from None
    if threshold is not None:
        judged = [(name, frames.at(threshold)) for name, frames in judged]
    measured = [Measured(name, frames, monitor_report(frames, level=args.level)) for name, frames in judged]
    trained = monitor.trained_on.get("scenarios", {})
    if not trained:
        print("note: the checkpoint does not say which scenarios it was trained on", file=sys.stderr)
    about = {
        "monitor": args.monitor,
        "type": monitor.config.type,
        "reads": ", ".join(monitor.input_features),
        "trained on": f"{len(trained)} scenarios" if trained else "not known",
        "decision": "the monitor's own" if threshold is None else f"score > {threshold:.6g}",
        "threshold": threshold,
        "chosen by": f"{args.choose_threshold} on {judged[0][0]}" if args.choose_threshold else "",
        "on training scenarios": "allowed" if args.on_training_scenarios else "refused",
        "package": __version__,
        "command": shlex.join(["roborecover", *sys.argv[1:]]),
    }
    page = write_monitor_report(args.out, measured, level=args.level, about=about)
    print(summary_text(measured, args.level))
    if threshold is not None:
        print(
            f"\nthreshold {threshold:.6g}"
            + (f", chosen by {about['chosen by']}" if about["chosen by"] else "")
        )
    print(f"\npage {page}\nnumbers {args.out / 'metrics.json'}")
    return 0
