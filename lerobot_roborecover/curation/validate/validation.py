"""Whether replay rebuilds the recovery point that a scenario was screened on; rules and verdicts.

Of each scenario, three of its screening runs are drawn (seed 42). Each is replayed: reset, prefix, then the
run's own recorded actions. A scenario stays if in every replay

- the end effectors and the objects are within 2 mm of where they were recorded;
- the frames look like the original's: per camera, the mean SSIM of the last five up to the recovery point
  exceeds 0.99;
- nothing crashes, and no action is refused;
- all replays reach one and the same simulator state, bit for bit: its hash becomes the scenario's;
- the screening run ends as it had ended, after as many steps.

The numbers are the paper's ("Replay-Based Data Checking"; appendix, "Difficulty Screening and Replay
Validation"); its validation pass rate is 97.32 %. The last point is how a replay shows that it went on from
the condition that the policy had met, without a record of the states in between. Pure functions.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lerobot_roborecover.curation.funnel import Decision, VerdictName
from lerobot_roborecover.scenario import HANDOFF_TOLERANCE_M, Fingerprint, Pose, Scenario, ScenarioError
from lerobot_roborecover.utils.text import align

PAPER_PASS_RATE = 0.9732
CRASH, INVALID_ACTION = "simulator crash", "invalid action"


@dataclass(frozen=True)
class ValidationRule:
    """What a scenario must pass; the defaults are the paper's."""

    runs: int = 3
    """Screening runs drawn of each scenario."""
    seed: int = 42
    """Seed of the draw."""
    tolerance_mm: float = HANDOFF_TOLERANCE_M * 1e3
    """Tolerance of end effectors and objects.

    The largest displacement, millimetres.
    """
    min_ssim: float = 0.99
    """The mean SSIM must exceed it."""
    frames: bool = True
    """Compare states alone; the provenance says so."""
    outcomes: bool = True
    """Do not compare how the screening runs end."""

    def __post_init__(self):
        if self.runs < 1 or self.tolerance_mm <= 0 or not 0 <= self.min_ssim < 1:
            raise ScenarioError(
                f"{self.runs} runs, {self.tolerance_mm:g} mm, SSIM above {self.min_ssim:g}: at least one "
                "run, a positive distance, and an SSIM from 0 to below 1"
            )


def draw_runs[R](scenario_id: str, runs: Sequence[R], rule: ValidationRule) -> list[R]:
    """The runs to replay; they depend on seed, scenario and runs alone.

    Args:
        scenario_id: whose.
        runs: in an order that does not depend on how they were run.
        rule: how many, and the seed.

    Returns:
        All of them where there are no more than asked for.
    """
    digest = hashlib.sha256(f"{rule.seed}/{scenario_id}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "little"))
    chosen = rng.choice(len(runs), size=min(rule.runs, len(runs)), replace=False) if len(runs) else []
    return [runs[i] for i in sorted(int(i) for i in chosen)]


@dataclass(frozen=True)
class RunReplay:
    policy: str
    trial: int
    eef_mm: float
    """Largest displacement of an end effector at the recovery point and, where the rollout's poses are known,
    in the four states before."""
    object_mm: float
    """The same of objects."""
    worst: str
    """Body and step of the largest displacement."""
    solved_by_prefix: bool
    state_sha256: str
    recorded: tuple[str, int]
    """Outcome and steps of the screening run."""
    replayed: tuple[str, int]
    """The same of its replay."""


@dataclass(frozen=True)
class Replays:
    """What the replays of a scenario gave; what is kept of them between runs."""

    runs: tuple[RunReplay, ...] = ()
    after_mm: float | None = None
    """Largest displacement of any body in the rollout's own further steps; None where they are not known."""
    ssim: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """By camera: SSIM of each of the last frames, of the replay that fares worst."""
    frames: str = "none"
    """What the original frames were, and how they were compared."""
    error: str = ""
    """Why a replay did not come to its end."""
    error_kind: str = ""
    """`CRASH` or `INVALID_ACTION`."""
    bodies: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Poses at the recovery point, in metres and as quaternion xyzw, as the first run's replay met them."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Versions of the simulator that replayed, as `Simulator.fingerprint` names them."""

    @property
    def eef_mm(self) -> float:
        """Largest displacement of an end effector."""
        return max((r.eef_mm for r in self.runs), default=float("nan"))

    @property
    def object_mm(self) -> float:
        """Largest displacement of an object."""
        return max((r.object_mm for r in self.runs), default=float("nan"))

    @property
    def mean_ssim(self) -> float:
        """Of the camera that fares worst; NaN without frames."""
        return min((float(np.mean(v)) for v in self.ssim.values()), default=float("nan"))

    @property
    def identical(self) -> bool:
        """Whether all replays reached the same state, bit for bit."""
        return len({r.state_sha256 for r in self.runs}) == 1

    def mark(self, scenario: Scenario) -> Fingerprint:
        """The scenario's fingerprint with the state that all replays reached.

        Poses stay as they were recorded, since those are what handoffs are held to; a scenario that has none
        gets those of the replay.

        Raises:
            ScenarioError: the replays reached more than one state, or none.
        """
        if not self.identical:
            states = sorted({r.state_sha256[:12] for r in self.runs})
            raise ScenarioError(
                f"scenario {scenario.id}: its {len(self.runs)} replays reached {len(states)} states "
                f"({', '.join(states)}); one is needed. Validate it again"
            )
        recorded = scenario.fingerprint
        if recorded is None:
            poses = {
                name: Pose((p[0], p[1], p[2]), (p[3], p[4], p[5], p[6])) for name, p in self.bodies.items()
            }
            recorded = Fingerprint(len(scenario.prefix), poses, "", {})
        versions = dict(self.versions) or recorded.versions
        return replace(recorded, state_sha256=self.runs[0].state_sha256, versions=versions)


def replays_from(entry: Mapping[str, Any]) -> Replays:
    """Replays as they were written with `dataclasses.asdict` and JSON."""
    fields = dict[str, Any](entry)
    fields["runs"] = tuple(_run_from(run) for run in entry["runs"])
    for name in ("ssim", "bodies"):
        fields[name] = {k: tuple(v) for k, v in entry.get(name, {}).items()}
    return Replays(**fields)


def _run_from(entry: Mapping[str, Any]) -> RunReplay:
    fields = dict[str, Any](entry)
    for name in ("recorded", "replayed"):
        fields[name] = tuple(entry[name])
    return RunReplay(**fields)


def judge(scenario_id: str, replays: Replays, rule: ValidationRule) -> Decision:
    """The verdict on a scenario; the first of several reasons is named, the detail has all values."""
    by = f"{len(replays.runs)} screening runs, seed {rule.seed}"

    def decided(verdict: VerdictName, reason: str, detail: str) -> Decision:
        return Decision(scenario_id, "validate", verdict, reason, detail, by)

    if replays.error:
        return decided("dropped", replays.error_kind or CRASH, replays.error)
    if len(replays.runs) < rule.runs:
        detail = f"{len(replays.runs)} valid trials in the trials folder; {rule.runs} are drawn"
        return decided("dropped", "too few screening runs", detail)
    values = [
        f"end effector {replays.eef_mm:.3f} mm, objects {replays.object_mm:.3f} mm ({_worst(replays)}), "
        f"limit {rule.tolerance_mm:g} mm"
    ]
    problems = []
    if any(r.solved_by_prefix for r in replays.runs):
        problems.append("solved by the prefix")
    if not replays.identical:
        problems.append("replays reach different states")
        values.append("states " + ", ".join(sorted({r.state_sha256[:12] for r in replays.runs})))
    # A distance that is not a number is no distance within the limit.
    if not replays.eef_mm <= rule.tolerance_mm:
        problems.append("end effector elsewhere")
    if not replays.object_mm <= rule.tolerance_mm:
        problems.append("objects elsewhere")
    if replays.after_mm is not None:
        values.append(f"rollout after the recovery point {replays.after_mm:.3f} mm")
        if not replays.after_mm <= rule.tolerance_mm and not problems:
            problems.append("rollout goes on otherwise")
    if rule.frames:
        values.append(f"mean SSIM {replays.mean_ssim:.5f}, above {rule.min_ssim:g} stays")
        if not replays.mean_ssim > rule.min_ssim:
            problems.append("frames differ")
    other = [r for r in replays.runs if r.recorded != r.replayed]
    if rule.outcomes and other:
        problems.append("screening run ends otherwise")
        values += [
            f"{r.policy} trial {r.trial}: {r.recorded[0]} after {r.recorded[1]} steps, now {r.replayed[0]} "
            f"after {r.replayed[1]}"
            for r in other
        ]
    detail = "; ".join(values if not problems[1:] else [*values, f"also: {', '.join(problems[1:])}"])
    return decided("dropped" if problems else "kept", problems[0] if problems else "", detail)


def _worst(replays: Replays) -> str:
    return max(replays.runs, key=lambda r: max(r.eef_mm, r.object_mm)).worst


def format_validation(
    replays: Mapping[str, Replays], decisions: Sequence[Decision], rule: ValidationRule
) -> str:
    """Pass rate and distributions as text.

    Args:
        replays: by scenario id.
        decisions: of this stage, those of people included.
        rule: what was asked for.
    """
    from scipy.stats import binomtest

    last = {d.candidate: d for d in decisions}
    passed, total = sum(d.verdict == "kept" for d in last.values()), len(last)
    low, high = binomtest(passed, total).proportion_ci(method="wilson") if total else (0.0, 0.0)
    lines = [
        f"{passed} of {total} pass: {100 * passed / max(total, 1):.2f} % [{100 * low:.1f}, {100 * high:.1f}] "
        f"(paper: {100 * PAPER_PASS_RATE:.2f} %)",
    ]
    whole = [r for r in replays.values() if r.runs and not r.error]
    rows: list[tuple[str, list[float], float, bool]] = [
        ("end effector, mm", [r.eef_mm for r in whole], rule.tolerance_mm, True),
        ("objects, mm", [r.object_mm for r in whole], rule.tolerance_mm, True),
        (
            "after the recovery point, mm",
            [r.after_mm for r in whole if r.after_mm is not None],
            rule.tolerance_mm,
            True,
        ),
    ]
    if rule.frames:
        rows.append(("mean SSIM", [r.mean_ssim for r in whole], rule.min_ssim, False))
    cells = [["", "median", "95 %", "worst", "limit"]]
    for title, values, limit, high_is_bad in rows:
        if values:
            at = (0.5, 0.95, 1.0) if high_is_bad else (0.5, 0.05, 0.0)
            cells.append([title, *(f"{v:.5f}" for v in np.quantile(values, at)), f"{limit:g}"])
    lines += align(cells)
    same = sum(r.identical for r in whole)
    lines.append(f"state identical in all replays, bit for bit: {same} of {len(whole)}")
    if not rule.frames:
        lines.append("frames were not compared (--no-frames)")
    return "\n".join(lines)
