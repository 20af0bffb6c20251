"""Trial logs in, a report out: the command's work, as a function."""

from __future__ import annotations

import gc
import sys
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.headline import headline
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.named_path import split_named
from lerobot_roborecover.analysis.options import Gallery, Options
from lerobot_roborecover.analysis.pages.gallery import check_scenarios
from lerobot_roborecover.analysis.pages.media import find_clips, videos_beside
from lerobot_roborecover.analysis.pages.report import REPORT_FILES, Extras, ReportFiles, write_report
from lerobot_roborecover.analysis.policy_tables import in_short
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.robot_tables import of_robots, starts_in_short
from lerobot_roborecover.analysis.tables import to_text
from lerobot_roborecover.utils.outputs import check_page
from lerobot_roborecover.utils.text import pluralize


@dataclass(frozen=True)
class Report:
    """A written report."""

    results: Results
    """The numbers."""
    files: ReportFiles
    """Where they are."""
    remarks: tuple[str, ...]
    """What a reader has to know about the pictures and the logs."""

    def text(self) -> str:
        """Its headline, the table of all policies, and where the files are."""
        table, robots = next(t for t in self.files.tables if t.name == "overall"), of_robots(self.results)
        overall = to_text(in_short(table, robots))
        if robots:
            overall += f"\nStart errors, medians\n{to_text(starts_in_short(self.results))}"
        out = self.files.html.parent
        return (
            f"{headline(self.results)}\n\n{overall}\n\nreport    {self.files.html}\nmarkdown  "
            f"{self.files.markdown}\ntables    {out / 'tables'}\nnumbers   {self.files.results}"
        )


def report(
    logs: str | Path | Sequence[str | Path] | Mapping[str, str | Path],
    out: str | Path,
    *,
    platform: str | None = None,
    title: str = "Recovery report",
    options: Options | None = None,
    gallery: Gallery | str | None = None,
    command: str = "",
) -> Report:
    """Writes tables with intervals, figures and one HTML page, from trial logs.

    Args:
        logs: files, or folders that hold `trials.jsonl`; a mapping gives each policy's name in the report,
            a text may be `NAME=LOG`.
        out: folder of the report; made if need be, an earlier report in it is replaced.
        platform: take this platform's rows only.
        title: heading.
        options: how intervals are drawn, and which policy is the baseline.
        gallery: the evaluated scenario set (shipped name, folder, Hub id), whose recorded frames are then
            shown beside each scenario's outcomes; a `Gallery` also takes videos from other folders. Videos
            beside the logs are shown without it.
        command: what made the report, for its last lines.

    Raises:
        TrialLogError: a log cannot be read.
        RowsError: the logs do not belong together.
        ScenarioError: the gallery's scenarios cannot be loaded, or are not the logs'.
        OutputExistsError: `out` holds files of a report's names that are of no report.
    """
    out = Path(out)
    gallery = gallery if isinstance(gallery, Gallery) else Gallery(gallery)
    check_page(out, REPORT_FILES)
    study = read_study(_named(logs), platform)
    with _no_garbage_yet():
        results = analyse(study, options)
    with _no_garbage_yet():
        frames, clips, remarks = _pictures(gallery, out, results)
        extras = Extras(frames, clips, tuple(remarks), title, command=command)
        files = write_report(results, out, extras)
    return Report(results, files, (*results.remarks, *remarks))


@contextmanager
def _no_garbage_yet() -> Generator[None]:
    """What is there now stays to the end: looking for garbage among millions of values takes long.

    Afterwards the collector looks at everything again, since a report may be one of many in a process; what
    the caller has frozen stays so.
    """
    ours = gc.get_freeze_count() == 0
    if ours:
        gc.freeze()
    try:
        yield
    finally:
        if ours:
            gc.unfreeze()


def _named(logs: str | Path | Sequence[str | Path] | Mapping[str, str | Path]) -> list[str]:
    if isinstance(logs, Mapping):
        return [f"{name}={path}" for name, path in logs.items()]
    return [str(logs)] if isinstance(logs, str | Path) else [str(log) for log in logs]


def _pictures(gallery: Gallery, out: Path, results: Results) -> tuple[dict, dict, list[str]]:
    frames: dict[str, bytes] = {}
    remarks: list[str] = []
    study, ids = results.study, [s.id for s in results.recovery.scenarios]
    if gallery.scenarios:
        from lerobot_roborecover.datasets import load_scenarios

        chosen = load_scenarios(gallery.scenarios, revision=gallery.revision)
        remarks += check_scenarios(
            (row for arm in study.arms for row in arm.rows), tuple(chosen), gallery.scenarios
        )
        wanted = [s for s in chosen if s.id in set(ids)]
        frames = {
            s.id: s.fingerprint.frames_png[-1] for s in wanted if s.fingerprint and s.fingerprint.frames_png
        }
        todo = [s for s in wanted if s.id not in frames]
        if not gallery.render and todo:
            remarks.append(
                f"{pluralize(len(todo), 'scenario')} of {gallery.scenarios} have no recovery frame: --render "
                "draws them"
            )
        if gallery.render and todo:
            from lerobot_roborecover.analysis.pages.pictures import render_frames

            print(f"rendering {len(todo)} recovery frames ...", file=sys.stderr)
            files, problem = render_frames(todo, out / "frames")
            frames |= {i: path.read_bytes() for i, path in files.items()}
            if problem:
                remarks.append(f"pictures are missing: {problem}")
    folders: list[tuple[str, Path]] = []
    for text in gallery.videos:
        name, rest = split_named(text)
        folders.append((name, Path(rest)))
    starts = {arm.title: arm.start for arm in study.arms}
    if not folders:
        rows = {arm.title: arm.rows for arm in study.arms}
        panels = (results.recovery, results.interventions)
        shown = {title for panel in panels if panel is not None for title in panel.arms}
        folders = [(arm, f) for arm, f in videos_beside(study.files.items(), starts, rows) if arm in shown]
    clips, skipped = find_clips(folders, ids, gallery.videos_mb * 2**20, starts)
    return frames, clips, remarks + skipped
