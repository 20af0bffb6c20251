"""Converts the paper's own release (scenario JSON files and split tables) to scenario datasets, and back.

    python conversion/roborecover_release.py RELEASE --out DIR             # DIR/libero, DIR/robotwin
    python conversion/roborecover_release.py ARCHIVE --splits CLONE/splits --out DIR
    python conversion/roborecover_release.py EXAMPLE.json --out DIR        # without a split table
    python conversion/roborecover_release.py RELEASE --out DIR --render    # also replay and render
    python conversion/roborecover_release.py DIR/libero DIR/robotwin --export --out RELEASE2

Actions stay float64, unclipped and unpadded; fields without a place of their own go to the provenance. A
record that fails is reported by file and field, and the rest goes on. Rules and limits: docs/publish.md.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from lerobot_roborecover.cli.output import guarded
from lerobot_roborecover.curation.split_dataset import SPLIT_FILE
from lerobot_roborecover.datasets import load_scenarios, write_scenarios
from lerobot_roborecover.datasets.fingerprint import fingerprint_scenarios
from lerobot_roborecover.datasets.licenses import license_argument
from lerobot_roborecover.datasets.release.convert import Conversion, Problem, platforms_of, read_release
from lerobot_roborecover.datasets.release.export import export_release
from lerobot_roborecover.datasets.release.initial_state import (
    check_initial_state,
    check_robot,
    initial_state_of,
)
from lerobot_roborecover.datasets.release.previous import compare_with_earlier, read_converted, read_earlier
from lerobot_roborecover.datasets.release.record import Reading
from lerobot_roborecover.datasets.release.single_records import read_files
from lerobot_roborecover.datasets.release.sources import Sources, read_sources
from lerobot_roborecover.datasets.release.tables import PLATFORMS
from lerobot_roborecover.datasets.render import check_rendering, render_dataset
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.platforms import SimulatorError
from lerobot_roborecover.platforms.libero.assets import find_assets
from lerobot_roborecover.platforms.robotwin.checkout import RobotwinCheckout
from lerobot_roborecover.platforms.robotwin.render import QUALITIES
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write, check_new
from lerobot_roborecover.workers.capacity import usable_cores
from lerobot_roborecover.workers.jobs import JobPool

_OWN_OPTIONS = {
    "--env.robotwin_root=<folder>": "--robotwin-root FOLDER",
    "--env.assets_dir": "--assets-dir",
    "--env.render_quality=trivial": "--render-quality trivial",
    "use --env.obs_type=state, which renders nothing": "--fingerprint alone, which renders nothing",
}
"""What messages of the simulators call an option of the evaluators, and what it is called here."""


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Arguments."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    add = parser.add_argument
    add(
        "source",
        nargs="+",
        help="the release's folder, or JSON files of it; with --export, or to replay it again, converted "
        "datasets (folders or Hub ids)",
    )
    add("--out", type=Path, required=True, help="folder to write to")
    add("--splits", type=Path, help="folder of the split tables, where they lie apart from the data")
    add("--platform", choices=PLATFORMS, help="convert this platform only")
    add("--sources", type=Path, help="CSV (name,source,source_policy): exceptions to the rules of sources")
    add("--keep-extra", action="store_true", help="keep unknown fields instead of refusing their records")
    add("--any-seed", action="store_true", help="take LIBERO records of other seeds than the release's 7")
    add(
        "--license",
        type=license_argument,
        help="licence by the Hub's identifier, of the data, for the manifest; none is assumed",
    )
    add("--fingerprint", action="store_true", help="replay each prefix: exact reset and handoff fingerprint")
    add(
        "--last-frames",
        action="store_true",
        help="--fingerprint, and the last five frames before each handoff",
    )
    add("--render", action="store_true", help="--last-frames, and the prefixes' observations as episodes")
    add("--size", type=int, default=256, help="LIBERO's picture side in pixels (%(default)s, as released)")
    add("--workers", type=int, default=usable_cores(), help="processes that replay (%(default)s)")
    add("--assets-dir", help="LIBERO's assets, where they are not found by themselves")
    add("--robotwin-root", help="RoboTwin checkout whose code replays (default: $ROBOTWIN_ROOT)")
    add("--render-quality", default="rt", choices=QUALITIES, help="of RoboTwin's pictures (%(default)s)")
    add("--export", action="store_true", help="write the original JSON files and split tables back")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    """Converts or exports; 0 done, 1 done but some records failed, 2 refused: nothing was converted."""
    args = parse(argv)
    try:
        return export(args) if args.export else convert(args)
    except (ScenarioError, SimulatorError) as err:
        text = str(err)
        for theirs, ours in _OWN_OPTIONS.items():
            text = text.replace(theirs, ours)
        print(f"roborecover_release: {text}", file=sys.stderr)
        return 2


def export(args: argparse.Namespace) -> int:
    """Writes the release's files back."""
    scenarios = [s for source in args.source for s in load_scenarios(source)]
    changed = export_release(scenarios, args.out)
    for problem in changed:
        print(problem, file=sys.stderr)
    print(
        f"{args.out}: {len(scenarios)} records, {len(scenarios) - len(changed)} with the hash of their table"
    )
    return int(bool(changed))


def convert(args: argparse.Namespace) -> int:
    """Converts every platform that is asked for."""
    results = read(args)
    if args.fingerprint or args.last_frames or args.render:
        # Refused before hours of replay, not after.
        check_simulators(args, {r.platform for r in results if r.scenarios})
    for result in results:
        if result.platform == "robotwin":
            refuse_other_robots(result, args.robotwin_root)
    counts = [write(args, result) for result in results]
    return 2 if not any(counts) else int(any(result.failures for result in results))


def read(args: argparse.Namespace) -> list[Conversion]:
    """The records of every platform that is asked for: of a release, single ones, or converted before."""
    reading = Reading(
        read_sources(args.sources) if args.sources else Sources(), args.keep_extra, args.any_seed
    )
    paths = [Path(source) for source in args.source]
    if all(path.is_file() for path in paths):
        results = read_files(paths, reading)
    elif all((path / FOLDER).is_dir() for path in paths):
        if not (args.fingerprint or args.last_frames or args.render):
            raise ScenarioError(
                f"{paths[0]} is converted already; say --fingerprint, --last-frames or --render to replay it "
                "again, or --export to write the release's files back"
            )
        results = [read_converted(path, reading) for path in paths]
    elif len(paths) > 1:
        raise ScenarioError(
            f"{len(paths)} sources; give the one folder that holds libero/ and robotwin/, and the folder of "
            "split tables with --splits where they lie apart; or JSON files alone"
        )
    else:
        platforms = [args.platform] if args.platform else platforms_of(paths[0], args.splits)
        if not platforms:
            raise ScenarioError(
                f"{args.splits or paths[0]} has no splits/libero_*.csv or splits/robotwin_*.csv; name the "
                "release's folder, and with --splits that of the tables (in the git clone) where it is "
                "another. JSON files are converted without a table when they are named themselves"
            )
        results = [read_release(paths[0], p, tables=args.splits, reading=reading) for p in platforms]
    chosen = [r for r in results if args.platform in (None, r.platform)]
    if not chosen:
        raise ScenarioError(f"none of the records is of {args.platform}, as --platform asks")
    return chosen


def check_simulators(args: argparse.Namespace, platforms: Collection[str]) -> None:
    """Checks that what replays is on this machine."""
    if "robotwin" in platforms:
        try:
            RobotwinCheckout(args.robotwin_root)
        except SimulatorError as err:
            raise SimulatorError(f"{err}; or convert LIBERO alone, with --platform libero") from None
    if "libero" in platforms:
        find_assets(args.assets_dir)


def refuse_other_robots(result: Conversion, robotwin_root: str | None) -> None:
    """Refuses the records that another robot than the checkout's made, where there is a checkout; replays
    nothing."""
    try:
        robot = RobotwinCheckout(robotwin_root).robot
    except SimulatorError:
        return  # a replay brings its own robot, and every handoff compares it
    for scenario in list(result.scenarios):
        try:
            check_robot(robot, initial_state_of(scenario))
        except ScenarioError as err:
            path = scenario.provenance["release"]["split_row"]["path"]
            result.failures.append(Problem(path, None, scenario.id, str(err)))
            result.scenarios.remove(scenario)


def write(args: argparse.Namespace, result: Conversion) -> int:
    """Writes one platform's dataset, reports what failed, and returns the number of scenarios."""
    out, work = args.out / result.platform, args.out / f".{result.platform}.work"
    pictures = args.render or args.last_frames
    # A conversion is replaced by a later one, e.g. with --fingerprint. Splits made from it are kept.
    if pictures or not (out / FOLDER / "conversion.json").is_file():
        check_new(out)
    elif (out / FOLDER / SPLIT_FILE).exists():
        raise ScenarioError(
            f"{out} was converted and then divided: results may rest on it. Name another --out"
        )
    earlier = read_earlier(out, args.fingerprint)
    said = {"description": "The paper's release, converted.", "license": args.license}
    deviations: dict[str, dict[str, float]] | None = None
    scenarios = result.scenarios
    if not (pictures or args.fingerprint) or not scenarios:
        if scenarios:
            write_scenarios(out, scenarios, **said)
        _report(result, scenarios, deviations, out)
        return len(scenarios)
    refused = len(result.failures)
    with JobPool(result.platform, _options(args, result.platform), args.workers) as pool:
        if pictures:
            check_rendering(scenarios, pool)
        scenarios, deviations = replay(result, work, pool)
        result.warnings.extend(compare_with_earlier(out, earlier, scenarios))
        if scenarios and pictures:
            render_dataset(
                out,
                scenarios,
                work,
                pool=pool,
                episodes=args.render,
                progress=lambda n, total: _progress(f"{result.platform}: rendered shards", n, total),
                **said,
            )
        elif scenarios:
            write_scenarios(out, scenarios, **said)
    if pictures or len(result.failures) == refused:
        shutil.rmtree(work, ignore_errors=True)
    _report(result, scenarios, deviations, out)
    return len(scenarios)


def replay(
    result: Conversion, work: Path, pool: JobPool
) -> tuple[list[Scenario], dict[str, dict[str, float]]]:
    """Replays every scenario; what cannot be is added to the failures.

    Returns:
        Those with their exact reset and fingerprint, and by id how far the first state was from the record's.
    """
    scenarios: list[Scenario] = []
    deviations: dict[str, dict[str, float]] = {}
    for done in fingerprint_scenarios(
        result.scenarios,
        work / "fingerprints.jsonl",
        check=check_initial_state,
        pool=pool,
        progress=lambda n, total: _progress(f"{result.platform}: replayed", n, total),
    ):
        path = done.scenario.provenance["release"]["split_row"]["path"]
        if done.error:
            result.failures.append(Problem(path, None, done.scenario.id, done.error))
            continue
        scenarios.append(done.scenario)
        deviations[done.scenario.id] = dict(done.deviations)
    return scenarios, deviations


def _options(args: argparse.Namespace, platform: str) -> dict[str, Any]:
    """Options of the platform's simulator; RoboTwin's own configuration says how large its pictures are."""
    obs_type = "pixels_agent_pos" if args.render or args.last_frames else "state"
    if platform == "robotwin":
        return {
            "robotwin_root": args.robotwin_root,
            "render_quality": args.render_quality,
            "obs_type": obs_type,
        }
    return {
        "assets_dir": args.assets_dir,
        "observation_height": args.size,
        "observation_width": args.size,
        "obs_type": obs_type,
    }


def _report(
    result: Conversion,
    scenarios: Sequence[Scenario],
    deviations: dict[str, dict[str, float]] | None,
    out: Path,
) -> None:
    """Says what became of the records, and leaves the same in the dataset; `deviations` where they were
    replayed."""
    worst: dict[str, float] = {}
    for found in (deviations or {}).values():
        worst = {name: max(value, worst.get(name, 0.0)) for name, value in found.items()}
    for problem in (*result.failures, *result.warnings):
        print(problem, file=sys.stderr)
    if not scenarios:
        why = (
            f"all of its {len(result.failures)} records were refused" if result.failures else "it has no rows"
        )
        print(f"roborecover_release: {result.platform}: nothing was converted, {why}", file=sys.stderr)
        return
    off = ", ".join(f"{name} {value:.2g}" for name, value in worst.items())
    state = "fingerprinted" + (f" (initial states off by at most {off})" if off else "")
    print(
        f"{out}: {len(scenarios)} scenarios converted, {len(result.failures)} refused; "
        + (
            state
            if deviations is not None
            else "usable for evaluation, not fingerprinted: the handoff is not checked"
        )
    )
    report = {
        "scenarios": len(scenarios),
        "fingerprinted": deviations is not None,
        "initial_state_largest_deviation": worst,
        "initial_state_deviations": deviations or {},
        "refused": [vars(p) for p in result.failures],
        "warnings": [vars(p) for p in result.warnings],
    }
    atomic_write(out / FOLDER / "conversion.json", json.dumps(report, indent=2) + "\n")


def _progress(what: str, done: int, total: int) -> None:
    print(f"\r{what} {done}/{total}", end="\n" if done == total else "", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(guarded("roborecover_release", main))
