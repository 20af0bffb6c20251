"""Parts b, c and d: trials from restored and from exact starts, and what they say of one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.stats.contrasts import Contrast, contrasts
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.resampling import resample
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.utils.journal import append_records, plain_records
from recipes.robot_lab.bench import POLICIES, Bench, ExactTrials, policy

REPEATS, EXACT_REPEATS = 1, 2
TOLERANCE = {"joint": 4.0, "object_px": 1.0, "background_px": 1.0}
MOTION = {"speed": 300.0, "tolerance": 2.0, "max_lag": 250.0, "max_detour": 50.0}
PLACING_SD_MM, MAX_TRIES = 4.0, 4
OFFSETS_MM = (10.0, 20.0, 40.0)
MARGIN = 0.10
"""Change of RSR below which a start error is called borne."""
AA_POLICY, AA_NAMES = "bias_45", ("first", "second")
AA_POINTS, AA_REPEATS, AA_STUDIES = 20, 2, 200
AA_SIZES = ((20, 2), (12, 2), (20, 1))
"""Points and repeats of the A/A studies; the first size is the primary one."""
SEED = 5


class _Operator:
    """The simulated operator, who notes how far each start that was run is really off."""

    def __init__(self, robot: Any, seed: int, path: Path):
        from lerobot_roborecover.robot.lab.operator import SimulatedOperator

        self._robot, self._path, self._truth = robot, path, None
        self._operator = SimulatedOperator(robot, seed=seed, sd_mm=PLACING_SD_MM, max_tries=MAX_TRIES)

    def answer(self, screen: str, details: dict[str, Any]) -> Any:
        """What is pressed on a screen."""
        if screen == "place":
            self._truth = dict(details["truth"]["objects"])
        if screen == "running" and self._truth is not None:
            true_mm = 1000 * self._robot.world.distance_m(self._truth)
            append_records(self._path, {"point": details["point"], "true_mm": round(true_mm, 3)})
            self._truth = None
        return self._operator.answer(screen, details)


def restored(
    bench: Bench, folder: Path, checkpoints: dict[str, str], repeats: int, points: int
) -> list[TrialRow]:
    """Runs a plan as `roborecover robot run` does; goes on where it stopped.

    Args:
        bench: of the lab and the points.
        folder: of the run.
        checkpoints: policies by name.
        repeats: of the plan.
        points: of the plan: the first so many.
    """
    from lerobot_roborecover.robot.console import Console
    from lerobot_roborecover.robot.plan import lock_plan, parse_plan
    from lerobot_roborecover.robot.run import RobotRun, RunConfig
    from lerobot_roborecover.robot.run_journal import RunJournal

    plan = parse_plan({
        "points": str(bench.points.root),
        "policies": {name: {"path": path} for name, path in checkpoints.items()},
        "select": [p.id for p in bench.points.points[:points]],
        "repeats": repeats, "seed": SEED, "tolerance": TOLERANCE, "motion": MOTION,
    })  # fmt: skip
    locked, found = lock_plan(plan, folder)
    journal = RunJournal(folder)
    try:
        with bench.lab() as robot:
            operator = _Operator(robot, len(journal.rows()), folder / "true_errors.jsonl")
            config = RunConfig(folder, "simulated")
            RobotRun(robot, locked, found, journal, Console(operator), config, say=lambda line: None).run()
    finally:
        journal.close()
    return read_trial_log(folder / "trials.jsonl")


def exact(bench: Bench, path: Path, offsets_mm: Sequence[float]) -> list[dict[str, Any]]:
    """Runs trials from exact starts with the puck so far off, in a direction of each trial's own.

    Args:
        bench: of the lab and the points.
        path: of the records; goes on where it stopped.
        offsets_mm: 0 is the exact start.
    """
    done = {_key(r) for r in plain_records(path)}
    with bench.lab() as robot:
        trials = ExactTrials(robot, {n: policy(bench.out, n, bias) for n, bias in POLICIES.items()})
        for number, point in enumerate(bench.points.points):
            for name in POLICIES:
                for offset_mm in offsets_mm:
                    for repeat in range(REPEATS if offset_mm else EXACT_REPEATS):
                        record: dict[str, Any] = {
                            "point": point.id, "policy": name, "repeat": repeat, "offset_mm": offset_mm
                        }  # fmt: skip
                        if _key(record) in done:
                            continue
                        rng = np.random.default_rng([SEED, number, repeat])
                        turn = rng.uniform(0, 2 * np.pi)
                        offset = offset_mm * np.array([np.cos(turn), np.sin(turn)])
                        append_records(path, {**record, "success": trials.run(name, point, offset)})
    return plain_records(path)


def _key(record: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(record[k] for k in ("point", "policy", "repeat", "offset_mm"))


def exact_rates(
    records: Sequence[dict[str, Any]], policies: Sequence[str], offset_mm: float
) -> dict[str, float]:
    """Success rate by point of policies, the puck so far off."""
    kept = [r for r in records if r["policy"] in policies and r["offset_mm"] == offset_mm]
    return _means([(r["point"], r["success"]) for r in kept])


def restored_rates(rows: Sequence[TrialRow], policy: str, valid_only: bool = False) -> dict[str, float]:
    """Success rate by point of one policy of a run; a start that was not run is a failure, or left out."""
    kept = [r for r in rows if r.options["policy_name"] == policy]
    if valid_only:
        kept = [r for r in kept if r.outcome in ("success", "horizon")]
    return _means([(r.scenario_id, r.success) for r in kept])


def _means(pairs: Sequence[tuple[str, bool]]) -> dict[str, float]:
    found: dict[str, list[bool]] = {}
    for point, success in pairs:
        found.setdefault(point, []).append(success)
    return {point: float(np.mean(values)) for point, values in found.items()}


def paired(a: dict[str, float], b: dict[str, float]) -> Contrast:
    """Rates a minus rates b over points, as a report compares two policies."""
    points = sorted(set(a) & set(b))
    rates = np.array([[rates[p] for p in points] for rates in (a, b)])
    return contrasts(rates, ("a", "b"), resample(np.arange(len(points)), 100, 0), unit="points")[0]


def mean_rate(rates: dict[str, float]) -> Estimate:
    """Mean over points with its interval."""
    values = np.array(list(rates.values()))[:, None]
    return resample(np.arange(len(values)), 100, 0).rates(values)[0]


@dataclass(frozen=True)
class AaStudies:
    """A/A studies of one size."""

    points: int
    repeats: int
    studies: int
    separated: int
    """Reports that call one of the two better."""
    p_below: int
    """Studies whose p is below 0.05, whatever the report's other rules say."""
    largest: float
    """Largest difference in absolute value."""


def aa_studies(rows: Sequence[TrialRow], points: int, repeats: int) -> AaStudies:
    """Deals trials of one policy to two names, study after study; counts those in which the names differ.

    Every study draws its points, and on each of them the trials of either name, without replacement.

    Args:
        rows: trials of one policy.
        points: of a study.
        repeats: trials of either name on each point.
    """
    pool: dict[str, list[bool]] = {}
    for row in rows:
        pool.setdefault(row.scenario_id, []).append(row.success)
    names = sorted(pool)
    rng = np.random.default_rng([SEED, points, repeats])
    found = []
    for _ in range(AA_STUDIES):
        arms: tuple[dict[str, float], dict[str, float]] = ({}, {})
        for name in rng.permutation(names)[:points]:
            dealt = rng.permutation(pool[str(name)])[: 2 * repeats]
            for arm, own in zip(arms, (dealt[:repeats], dealt[repeats:]), strict=True):
                arm[str(name)] = float(own.mean())
        found.append(paired(*arms))
    return AaStudies(
        points,
        repeats,
        len(found),
        sum(c.verdict.separated for c in found),
        sum(c.p < 0.05 for c in found),
        max(abs(c.difference.value) for c in found),
    )
