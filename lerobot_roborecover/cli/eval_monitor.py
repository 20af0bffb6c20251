"""`roborecover eval-monitor`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

HELP = (
    "Measure a trained monitor on held-out frames (--monitor, --data): accuracy, precision, recall, F1, "
    "Macro-F1, FPR, confusion counts, curves, trigger rate and detection delay. Or compare detectors side by "
    "side on a policy's own trials (--detector, --scenarios, --policy): who needs help, delays, false alarms "
    "a minute, calibration, conformal thresholds, cost. With intervals over scenarios."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("--monitor", help="checkpoint: folder or Hub id")
    add("--revision", help="commit, tag or branch of a Hub id")
    add(
        "--data", action="append", metavar="[NAME=]DIR",
        help="frames of `roborecover monitor-data`; may be given again",
    )  # fmt: skip
    add("--out", type=Path, default=Path("outputs/monitor"), help="folder of the report (%(default)s)")
    add("--device", help="where the monitor, the policy and the detectors run")
    add("--base-model", help="base of the Qwen3-VL monitor, where its checkpoint names another place")
    add("--threshold", type=float, help="decide by score > THRESHOLD instead of the monitor's own answer")
    add(
        "--choose-threshold", metavar="RULE",
        help="choose it on the first --data: macro_f1, f1, accuracy, youden, or fpr=0.05",
    )  # fmt: skip
    add(
        "--on-training-scenarios", action="store_true",
        help="measure also on scenarios that the monitor was trained on: says nothing about others",
    )  # fmt: skip
    add("--num-workers", type=int, default=0, help="processes that read frames (%(default)s)")
    add("--draws", type=int, default=10_000, help="without effect: the intervals need no draws")
    add("--seed", type=int, default=0, help="without effect, likewise")
    add("--level", type=float, default=0.95, help="confidence level (%(default)s)")
    side = parser.add_argument_group("detectors side by side")
    add = side.add_argument
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
        help="log of `roborecover fork` on trials of the policy, for recovery_gain",
    )  # fmt: skip
    add(
        "--alpha", type=float, default=0.1,
        help="chance of a false alarm in a clean rollout that conformal thresholds allow (%(default)s)",
    )  # fmt: skip
    add(
        "--against", action="append", default=[], metavar="NAME",
        help="test pairs with this detector alone; may be given again (all pairs)",
    )  # fmt: skip
    add("--films", type=int, default=3, help="trials shown as film strips; 0 renders none (%(default)s)")
    add("--work", type=Path, help="folder of trials and observations, kept between runs (OUT.work)")
    add("--workers", type=int, default=1, help="processes that replay and render (%(default)s)")
    add(
        "--env", action="append", default=[], metavar="NAME=VALUE",
        help="option of the recovery env type, e.g. obs_type=state; may be given again",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Judges, computes, writes and prints."""
    from lerobot_roborecover.policies.detectors.monitor.errors import MonitorError

    frames, side = ("monitor", "data"), ("detector", "scenarios", "policy")
    if args.scores:
        clash = [name for name in (*frames, *side) if getattr(args, name)]
        if clash:
            raise MonitorError(
                f"--{clash[0]} does not belong to --scores, which reports a finished comparison. Leave "
                "out one"
            )
        return _from_scores(args)
    wanted, others = (side, frames) if args.detector else (frames, side)
    missing = [name for name in wanted if not getattr(args, name)]
    clash = [name for name in others if getattr(args, name)]
    if missing or clash:
        what = f"--{missing[0]} is missing" if missing else f"--{clash[0]} does not belong to --{wanted[0]}"
        raise MonitorError(
            f"{what}. Give --monitor and --data to measure a monitor on frames; or --detector, --scenarios "
            "and --policy to compare detectors on a policy's trials"
        )
    return _side_by_side(args) if args.detector else _on_frames(args)


def _side_by_side(args: argparse.Namespace) -> int:
    """Detectors on a policy's trials."""
    from lerobot_roborecover._version import __version__
    from lerobot_roborecover.analysis.pages.detection import (
        DETECTION_FILES,
        detection_text,
        write_detection_report,
    )
    from lerobot_roborecover.detection.request import DetectionRequest, compare_detectors
    from lerobot_roborecover.detection.strips import choose_trials, film_strips
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
    strips, problem = film_strips(found.trials, choose_trials(found.trials, args.films))
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


def _from_scores(args: argparse.Namespace) -> int:
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


def _on_frames(args: argparse.Namespace) -> int:
    """One monitor on labelled frames."""
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
    from lerobot_roborecover.policies.detectors.monitor.errors import MonitorError
    from lerobot_roborecover.policies.detectors.monitor_interface import TrainedMonitor
    from lerobot_roborecover.policies.detectors.monitor_loading import load_monitor
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
