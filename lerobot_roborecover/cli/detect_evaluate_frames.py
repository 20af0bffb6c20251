"""`roborecover detect evaluate-frames`: a trained monitor on labelled frames."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.options import option

HELP = (
    "Measure a trained monitor on held-out labelled frames: accuracy, precision, recall, F1, Macro-F1, FPR, "
    "confusion counts, curves, trigger rate and detection delay. With intervals over scenarios."
)


@dataclass(frozen=True, kw_only=True)
class FrameOptions:
    """A monitor, its frames, and how it is measured."""

    monitor: str = option("", show_default=False)
    """Checkpoint: folder or Hub id."""
    revision: str | None = None
    """Commit, tag or branch of a Hub id."""
    data: tuple[str, ...] = option((), metavar="[NAME=]DIR", show_default=False)
    """Frames of `roborecover detect data`; may be given again."""
    threshold: float | None = None
    """Decide by score > THRESHOLD instead of the monitor's own answer."""
    choose_threshold: str | None = option(None, metavar="RULE")
    """Choose it on the first --data: macro_f1, f1, accuracy, youden, or fpr=0.05."""
    num_workers: int = 0
    """Processes that read frames."""
    out: Path = Path("outputs/monitor")
    """Folder of the report."""
    device: str | None = None
    """Where the monitor runs."""
    base_model: str | None = None
    """Base of the Qwen3-VL monitor, where its checkpoint names another place."""
    on_training_scenarios: bool = False
    """Measure also on scenarios that the monitor was trained on: says nothing about others."""
    level: float = 0.95
    """Confidence level."""


@dataclass(frozen=True, kw_only=True)
class DetectFramesOptions(FrameOptions):
    """The same; the monitor and the frames have to be named."""

    monitor: str = option()
    """Checkpoint: folder or Hub id."""
    data: tuple[str, ...] = option(metavar="[NAME=]DIR")
    """Frames of `roborecover detect data`; may be given again."""


OPTIONS = DetectFramesOptions


def run(options: FrameOptions) -> int:
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
    from lerobot_roborecover.policies.detectors.interface import DetectorError
    from lerobot_roborecover.policies.detectors.loading import load_monitor
    from lerobot_roborecover.utils.outputs import check_page
    from lerobot_roborecover.utils.progress import Progress

    check_page(options.out, MONITOR_FILES)
    if options.threshold is not None and options.choose_threshold:
        raise DetectorError("--threshold and --choose-threshold: give one of them")
    if options.threshold is not None and not 0 < options.threshold < 1:
        raise DetectorError(f"--threshold={options.threshold}: must be above 0 and below 1")
    overrides = {"base_model": options.base_model} if options.base_model else {}
    monitor = load_monitor(options.monitor, options.device, options.revision, **overrides)
    judged = []
    for text in options.data:
        name, rest = split_named(text)
        frames, _ = judge_dataset(
            monitor,
            Path(rest),
            num_workers=options.num_workers,
            on_training_scenarios=options.on_training_scenarios,
            on_batch=Progress("frame"),
        )
        judged.append((name or Path(rest).name, frames))
    if len({name for name, _ in judged}) < len(judged):
        raise DetectorError(f"two datasets have one name: {[n for n, _ in judged]}; write --data NAME=DIR")
    threshold = options.threshold
    if options.choose_threshold:
        try:
            threshold = choose_threshold(judged[0][1], options.choose_threshold)
        except ValueError as err:
            raise DetectorError(f"--choose-threshold={options.choose_threshold}: {err}") from None
    if threshold is not None:
        judged = [(name, frames.at(threshold)) for name, frames in judged]
    measured = [
        Measured(name, frames, monitor_report(frames, level=options.level)) for name, frames in judged
    ]
    trained = monitor.trained_on.get("scenarios", {})
    if not trained:
        print("note: the checkpoint does not say which scenarios it was trained on", file=sys.stderr)
    about = {
        "monitor": options.monitor,
        "type": monitor.config.type,
        "reads": ", ".join(monitor.needs.features),
        "trained on": f"{len(trained)} scenarios" if trained else "not known",
        "decision": "the monitor's own" if threshold is None else f"score > {threshold:.6g}",
        "threshold": threshold,
        "chosen by": f"{options.choose_threshold} on {judged[0][0]}" if options.choose_threshold else "",
        "on training scenarios": "allowed" if options.on_training_scenarios else "refused",
        "package": __version__,
        "command": shlex.join(["roborecover", *sys.argv[1:]]),
    }
    page = write_monitor_report(options.out, measured, level=options.level, about=about)
    print(summary_text(measured, options.level))
    if threshold is not None:
        print(
            f"\nthreshold {threshold:.6g}"
            + (f", chosen by {about['chosen by']}" if about["chosen by"] else "")
        )
    print(f"\npage {page}\nnumbers {options.out / 'metrics.json'}")
    return 0
