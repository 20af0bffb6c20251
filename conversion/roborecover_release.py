"""Converts the paper's own release (scenario JSON files and split tables) to scenario datasets, and back.

    python conversion/roborecover_release.py RELEASE --out DIR             # DIR/libero, DIR/robotwin
    python conversion/roborecover_release.py RELEASE --out DIR --render    # also replay and render
    python conversion/roborecover_release.py DIR/libero DIR/robotwin --export --out RELEASE2

Actions stay float64, unclipped and unpadded; fields without a place of their own go to the provenance. A
record that fails is reported by file and field, and the rest goes on. Rules and limits: docs/convert.md.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot_roborecover.datasets import load_scenarios, write_scenarios
from lerobot_roborecover.datasets.fingerprint import fingerprint_scenarios
from lerobot_roborecover.datasets.release.convert import (
    Conversion,
    Problem,
    export_release,
    platforms_of,
    read_release,
    read_sources,
)
from lerobot_roborecover.datasets.release.initial_state import check_initial_state
from lerobot_roborecover.datasets.release.record import RULES
from lerobot_roborecover.datasets.render import check_rendering, render_dataset
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.simulators import SimulatorError
from lerobot_roborecover.simulators.robotwin_checkout import RobotwinCheckout
from lerobot_roborecover.simulators.robotwin_render import QUALITIES
from lerobot_roborecover.whole import check_new


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Arguments."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    add = parser.add_argument
    add(
        "source",
        nargs="+",
        help="the release's folder; with --export, converted datasets (folders or Hub ids)",
    )
    add("--out", type=Path, required=True, help="folder to write to")
    add("--platform", choices=("libero", "robotwin"), help="convert this platform only")
    add("--sources", type=Path, help="CSV (name,source,source_policy): exceptions to the rules of sources")
    add("--keep-extra", action="store_true", help="keep unknown fields instead of refusing their records")
    add("--license", help="SPDX identifier of the data, for the manifest; none is assumed")
    add("--fingerprint", action="store_true", help="replay each prefix: exact reset and handoff fingerprint")
    add("--render", action="store_true", help="--fingerprint, and the prefixes' observations as episodes")
    add("--size", type=int, default=256, help="LIBERO's picture side in pixels (%(default)s, as released)")
    add("--workers", type=int, default=os.cpu_count() or 1, help="processes that replay (%(default)s)")
    add("--assets-dir", help="LIBERO's assets, where they are not found by themselves")
    add("--robotwin-root", help="RoboTwin checkout whose code replays (default: $ROBOTWIN_ROOT)")
    add("--render-quality", default="rt", choices=QUALITIES, help="of RoboTwin's pictures (%(default)s)")
    add("--export", action="store_true", help="write the original JSON files and split tables back")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    """Converts or exports; 0 done, 1 done but some records failed, 2 refused."""
    args = parse(argv)
    try:
        return export(args) if args.export else convert(args)
    except (ScenarioError, SimulatorError) as err:
        print(f"roborecover_release: {err}", file=sys.stderr)
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
    """Converts every platform of the release that is asked for."""
    if len(args.source) > 1:
        raise ScenarioError(f"{len(args.source)} sources; give the one folder that holds splits/")
    root = Path(args.source[0])
    sources = read_sources(args.sources) if args.sources else RULES
    platforms = [args.platform] if args.platform else platforms_of(root)
    if not platforms:
        raise ScenarioError(
            f"{root} has no splits/libero_*.csv or splits/robotwin_*.csv; name the release's folder"
        )
    if "robotwin" in platforms and (args.render or args.fingerprint):
        # Refused before LIBERO's hours of replay, not after.
        RobotwinCheckout(args.robotwin_root)
    status = 0
    for platform in platforms:
        result = read_release(root, platform, sources=sources, keep_extra=args.keep_extra)
        status |= write(args, result)
    return status


def write(args: argparse.Namespace, result: Conversion) -> int:
    """Writes one platform's dataset and reports what failed."""
    out, work = args.out / result.platform, args.out / f".{result.platform}.work"
    replay = args.render or args.fingerprint
    if args.render:
        check_new(out)
    looking = {**_options(args, result.platform), "obs_type": "pixels_agent_pos"}
    if args.render and result.scenarios:
        check_rendering(result.scenarios, looking)
    scenarios: list[Scenario] = result.scenarios
    deviations: dict[str, dict[str, float]] = {}
    refused = len(result.failures)
    if replay:
        scenarios = []
        for done in fingerprint_scenarios(
            result.scenarios,
            work / "fingerprints.jsonl",
            options={**_options(args, result.platform), "obs_type": "state"},
            check=check_initial_state,
            workers=args.workers,
            progress=lambda n, total: _progress(f"{result.platform}: replayed", n, total),
        ):
            path = done.scenario.provenance["release"]["split_row"]["path"]
            if done.error:
                result.failures.append(Problem(path, None, done.scenario.id, done.error))
                continue
            scenarios.append(done.scenario)
            deviations[done.scenario.id] = dict(done.deviations)
    said = {"description": "The paper's release, converted.", "license": args.license}
    if scenarios and replay and args.render:
        render_dataset(
            out,
            scenarios,
            work,
            options=looking,
            workers=args.workers,
            progress=lambda n, total: _progress(f"{result.platform}: rendered shards", n, total),
            **said,
        )
    elif scenarios:
        write_scenarios(out, scenarios, **said)
    if replay and (args.render or len(result.failures) == refused):
        shutil.rmtree(work)
    _report(result, scenarios, deviations, out, replay)
    return int(bool(result.failures))


def _options(args: argparse.Namespace, platform: str) -> dict[str, Any]:
    """Options of the platform's simulator; RoboTwin's own configuration says how large its pictures are."""
    if platform == "robotwin":
        return {"robotwin_root": args.robotwin_root, "render_quality": args.render_quality}
    size = {"observation_height": args.size, "observation_width": args.size}
    return {"assets_dir": args.assets_dir, **size}


def _report(
    result: Conversion,
    scenarios: Sequence[Scenario],
    deviations: dict[str, dict[str, float]],
    out: Path,
    replayed: bool,
) -> None:
    """Says what became of the records, and leaves the same in the dataset."""
    worst: dict[str, float] = {}
    for found in deviations.values():
        worst = {name: max(value, worst.get(name, 0.0)) for name, value in found.items()}
    for problem in (*result.failures, *result.warnings):
        print(problem, file=sys.stderr)
    off = ", ".join(f"{name} {value:.2g}" for name, value in worst.items())
    state = "fingerprinted" + (f" (initial states off by at most {off})" if off else "")
    print(
        f"{out if scenarios else result.platform}: {len(scenarios)} scenarios converted, "
        f"{len(result.failures)} refused; "
        + (state if replayed else "usable for evaluation, not fingerprinted: the handoff is not checked")
    )
    if scenarios:
        report = {
            "scenarios": len(scenarios),
            "fingerprinted": replayed,
            "initial_state_largest_deviation": worst,
            "initial_state_deviations": deviations,
            "refused": [vars(p) for p in result.failures],
            "warnings": [vars(p) for p in result.warnings],
        }
        (out / FOLDER / "conversion.json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def _progress(what: str, done: int, total: int) -> None:
    print(f"\r{what} {done}/{total}", end="\n" if done == total else "", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
