"""`roborecover detect evaluate`: detectors side by side on a policy's own trials."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from lerobot_roborecover.detection.options import DetectionRequest
from lerobot_roborecover.utils.options import option

HELP = (
    "Compare failure detectors side by side on a policy's own trials: ranking, delays, false alarms a "
    "minute, calibration, conformal thresholds, cost. With intervals over scenarios."
)


@dataclass(frozen=True, kw_only=True)
class DetectOptions:
    """What is compared, or which comparison is reported again."""

    comparison: DetectionRequest = field(default_factory=DetectionRequest)
    scores: Path | None = option(None, metavar="DIR")
    """Run nothing: report the scores in the --out of an earlier comparison."""
    frame_strips: int = option(3, old=("films",))
    """Trials shown frame by frame; 0: none."""
    work: Path | None = None
    """Folder of trials and observations, kept between runs (OUT.work)."""
    out: Path = Path("outputs/detectors")
    """Folder of the report."""

    @property
    def needed(self) -> dict[str, object]:
        """What a comparison needs, by its option's name; a report of an earlier one does without."""
        source = self.comparison.source
        return {
            "detector": self.comparison.detectors,
            "scenarios": source.scenarios,
            "policy": source.policy,
        }


OPTIONS = DetectOptions


def run(options: DetectOptions) -> int:
    """Runs the trials, computes, writes and prints; or reports an earlier comparison."""
    from lerobot_roborecover.policies.detectors.interface import DetectorError

    if options.scores:
        refuse_with_scores(options.needed)
        return report_scores(options.scores, options.out)
    missing = [name for name, value in options.needed.items() if not value]
    if missing:
        raise DetectorError(
            f"--{missing[0]} is missing. Give --detector, --scenarios and --policy to compare detectors; or "
            "--scores, the --out of an earlier comparison, to report it again"
        )
    return compare(options)


def refuse_with_scores(given: Mapping[str, object]) -> None:
    """Refuses options that a report of a finished comparison does not take.

    Args:
        given: their values, by name.

    Raises:
        DetectorError: one of them is given.
    """
    from lerobot_roborecover.policies.detectors.interface import DetectorError

    clash = [name for name, value in given.items() if value]
    if clash:
        raise DetectorError(
            f"--{clash[0]} does not belong to --scores, which reports a finished comparison. Leave out one"
        )


def compare(options: DetectOptions) -> int:
    """Compares detectors on a policy's trials."""
    from lerobot_roborecover._version import __version__
    from lerobot_roborecover.analysis.pages.detection import (
        DETECTION_FILES,
        detection_text,
        write_detection_report,
    )
    from lerobot_roborecover.detection.request import compare_detectors
    from lerobot_roborecover.detection.strips import choose_trials, frame_strips
    from lerobot_roborecover.utils.outputs import check_page
    from lerobot_roborecover.utils.progress import Progress

    check_page(options.out, DETECTION_FILES)
    work = options.work or options.out.with_name(f"{options.out.name}.work")
    source = replace(options.comparison.source, work=work)
    request = replace(options.comparison, source=source)
    found = compare_detectors(request, options.out, Progress("trial").of)
    strips, problem = frame_strips(found.trials, choose_trials(found.trials, options.frame_strips))
    remarks = [*found.remarks, *([f"no pictures: {problem}"] if problem else [])]
    remarks += [f"left out {n}: {reason}" for reason, n in found.dropped.most_common()]
    about = {
        "policy": source.policy,
        "scenarios": f"{source.scenarios}, split {request.split}",
        "trials": f"{len(found.trials)}, {source.trials} of each scenario from each start",
        "false-alarm rate": f"{request.alpha:g} a clean rollout",
        "package": __version__,
        "command": shlex.join(["roborecover", *sys.argv[1:]]),
        **({"remarks": "; ".join(remarks)} if remarks else {}),
    }
    page = write_detection_report(
        options.out, found.measured, found.scored, strips, alpha=request.alpha, level=request.level,
        seed=request.seed, about=about, pairs=found.pairs, against=request.against,
    )  # fmt: skip
    print(detection_text(found.measured, found.pairs, request.alpha, request.level))
    for remark in remarks:
        print(f"\nnote: {remark}", file=sys.stderr)
    for m in found.measured:
        if m.saved:
            print(f"use it: --policy.monitor.path={m.saved}")
    print(f"\npage {page}\nnumbers {options.out / 'detectors.json'}")
    return 0


def report_scores(scores: Path, out: Path) -> int:
    """Reports a finished comparison of detectors again.

    Args:
        scores: the `--out` of that comparison.
        out: folder of the report.
    """
    from lerobot_roborecover.analysis.pages.detection import (
        DETECTION_FILES,
        detection_text,
        write_detection_report,
    )
    from lerobot_roborecover.analysis.stored_comparison import read_comparison
    from lerobot_roborecover.utils.outputs import check_page

    check_page(out, DETECTION_FILES)
    found = read_comparison(scores)
    page = write_detection_report(
        out, found.measured, found.scored, (), alpha=found.alpha, level=found.level, seed=found.seed,
        about=found.about, pairs=found.pairs, against=found.against,
    )  # fmt: skip
    print(detection_text(found.measured, found.pairs, found.alpha, found.level))
    print(f"\npage {page}")
    return 0
