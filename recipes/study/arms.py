"""The runs of a study's evaluation: nothing else is needed to do it by hand."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from lerobot_roborecover.evaluation.spec import RunSpec
from lerobot_roborecover.policies.interventions.options import POLICY_TYPE
from recipes.study.definition import StudyDefinition

STARTS = ("recovery", "initial")


@dataclass(frozen=True)
class StudyArm:
    """One run of `roborecover eval`."""

    name: str
    """The policy, or the intervention."""
    start: str
    trials: int
    run: RunSpec

    @property
    def label(self) -> str:
        """What it is called in progress lines and in `outcomes.csv`."""
        return f"{self.name}/{self.start}"

    @property
    def out(self) -> Path:
        """Folder of its results."""
        return self.run.output_dir

    @property
    def log(self) -> Path:
        """Its trial log."""
        return self.out / "trials.jsonl"


def arms(study: StudyDefinition, out: Path, ids: Sequence[str] = (), slots: int = 0) -> Iterator[StudyArm]:
    """Every run of the evaluation: each policy from both starts, then the interventions.

    Args:
        study: what.
        out: folder of the results.
        ids: scenarios; empty takes the whole split.
        slots: simulators at once; 0: one per core.
    """
    for name, trials in study.policies.items():
        for start in STARTS:
            policy = {"path": study.policy(name)}
            yield _arm(study, out, name, start, trials, policy, ids, slots)
    for mode in study.interventions:
        policy = {"type": POLICY_TYPE, "mode": mode, "base": {"path": study.policy(study.base)}}
        if mode.endswith("correction"):
            policy["correction"] = {"path": study.correction}
        if mode.startswith("monitor"):
            policy["monitor"] = {"path": study.monitor}
        yield _arm(study, out, mode, "recovery", study.policies[study.base], policy, ids, slots)


def report_command(study: StudyDefinition, done: Sequence[StudyArm], out: Path) -> str:
    """The report on the runs' logs as a command line."""
    logs = [f"{arm.name}={arm.log}" for arm in done]
    argv = ["report", *logs, "--out", str(out / "report"), "--scenarios", str(study.scenarios)]
    if study.interventions:
        argv += ["--baseline", study.base]
        for mode in study.interventions:
            argv += ["--intervention", mode]
    return shlex.join(["roborecover", *argv])


def _arm(
    study: StudyDefinition, out: Path, name: str, start: str, trials: int,
    policy: Mapping[str, Any], ids: Sequence[str], slots: int,
) -> StudyArm:  # fmt: skip
    folder = out / "trials" / f"{name}-{start}"
    env = {
        "scenarios": study.scenarios,
        "split": study.split,
        "start": start,
        **({"select": f"id={'|'.join(ids)}"} if ids else {}),
        **{option: yaml.safe_load(text) for option, text in sorted(study.env.items())},
        "trial_log": folder / "trials.jsonl",
        # All runs share the snapshots of recovery points.
        "snapshot_dir": out / "snapshots",
    }
    # One observation a batch: an inference then rounds alike, whichever other trials wait.
    runner = {"max_batch": 1, "cross_cpu_deterministic": True, "slots": slots}
    run = RunSpec(study.platform, env, {**policy, "device": "cpu"}, trials, folder, runner=runner)
    return StudyArm(name, start, trials, run)
