"""`roborecover eval-monitor`: old name of `detect evaluate` and `detect evaluate-frames`, for one release."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from lerobot_roborecover.cli import detect_evaluate, detect_evaluate_frames
from lerobot_roborecover.cli.detect_evaluate import DetectOptions
from lerobot_roborecover.cli.detect_evaluate_frames import FrameOptions
from lerobot_roborecover.detection.options import DetectionRequest
from lerobot_roborecover.utils.options import option

HELP = (
    "Measure a trained monitor on held-out frames (--monitor, --data): accuracy, precision, recall, F1, "
    "Macro-F1, FPR, confusion counts, curves, trigger rate and detection delay. Or compare detectors side by "
    "side on a policy's own trials (--detector, --scenarios, --policy): ranking, delays, false alarms "
    "a minute, calibration, conformal thresholds, cost. With intervals over scenarios."
)


@dataclass(frozen=True, kw_only=True)
class EvalMonitorOptions(FrameOptions):
    """Options of both commands."""

    draws: int = 10_000
    """Without effect: the intervals need no draws."""
    workers: int = option(1)
    """Processes that replay and render; --num-workers are those that read frames."""
    side_by_side: DetectionRequest = option(factory=DetectionRequest, group="detectors side by side")
    scores: Path | None = option(None, metavar="DIR")
    """Run nothing: report the scores in the --out of an earlier comparison."""
    frame_strips: int = option(3, old=("films",))
    """Trials shown frame by frame; 0: none."""
    work: Path | None = None
    """Folder of trials and observations, kept between runs (OUT.work)."""

    def comparison(self) -> DetectOptions:
        source = replace(self.side_by_side.source, workers=self.workers)
        return DetectOptions(
            comparison=replace(self.side_by_side, source=source),
            scores=self.scores,
            frame_strips=self.frame_strips,
            work=self.work,
            out=self.out,
        )


OPTIONS = EvalMonitorOptions


def run(options: EvalMonitorOptions) -> int:
    """Runs the one of the two commands that the options belong to."""
    from lerobot_roborecover.policies.detectors.interface import DetectorError

    frames = {"monitor": options.monitor, "data": options.data}
    comparison = options.comparison()
    if options.scores:
        detect_evaluate.refuse_with_scores(frames | comparison.needed)
        return detect_evaluate.report_scores(options.scores, options.out)
    chosen = bool(options.side_by_side.detectors)
    wanted, others = (comparison.needed, frames) if chosen else (frames, comparison.needed)
    missing = [name for name, value in wanted.items() if not value]
    clash = [name for name, value in others.items() if value]
    if missing or clash:
        first = next(iter(wanted))
        what = f"--{missing[0]} is missing" if missing else f"--{clash[0]} does not belong to --{first}"
        raise DetectorError(
            f"{what}. Give --monitor and --data to measure a monitor on frames; or --detector, --scenarios "
            "and --policy to compare detectors on a policy's trials"
        )
    return detect_evaluate.compare(comparison) if chosen else detect_evaluate_frames.run(options)
