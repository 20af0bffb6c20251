"""The commands of a study's evaluation: nothing else is needed to do it by hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.study.definition import StudyDefinition

STARTS = ("recovery", "initial")


@dataclass(frozen=True)
class Arm:
    """One run of `roborecover eval`."""

    name: str
    """The policy, or the intervention."""
    start: str
    trials: int
    argv: tuple[str, ...]
    """`roborecover ARGV`."""
    out: Path

    @property
    def label(self) -> str:
        """What it is called in progress lines and in `outcomes.csv`."""
        return f"{self.name}/{self.start}"

    @property
    def log(self) -> Path:
        """Its trial log."""
        return self.out / "trials.jsonl"


def arms(study: StudyDefinition, out: Path, ids: Sequence[str] = (), slots: int = 0) -> Iterator[Arm]:
    """Every run of the evaluation: each policy from both starts, then the interventions.

    Args:
        study: what.
        out: folder of the results.
        ids: scenarios; empty takes the whole split.
        slots: simulators at once; 0: one per core.
    """
    for name, trials in study.policies.items():
        for start in STARTS:
            policy = [f"--policy.path={study.policy(name)}"]
            yield _arm(study, out, name, start, trials, policy, ids, slots)
    for mode in study.interventions:
        policy = ["--policy.type=roborecover_intervention", f"--policy.mode={mode}"]
        policy.append(f"--policy.base.path={study.policy(study.base)}")
        if mode.endswith("correction"):
            policy.append(f"--policy.correction.path={study.correction}")
        if mode.startswith("monitor"):
            policy.append(f"--policy.monitor.path={study.monitor}")
        yield _arm(study, out, mode, "recovery", study.policies[study.base], policy, ids, slots)


def report_command(study: StudyDefinition, done: Sequence[Arm], out: Path) -> list[str]:
    """`roborecover report` on the runs' logs."""
    logs = [f"{arm.name}={arm.log}" for arm in done]
    argv = ["report", *logs, "--out", str(out / "report"), "--scenarios", str(study.scenarios)]
    if study.interventions:
        argv += ["--baseline", study.base]
        for mode in study.interventions:
            argv += ["--intervention", mode]
    return argv


def _arm(
    study: StudyDefinition, out: Path, name: str, start: str, trials: int,
    policy: Sequence[str], ids: Sequence[str], slots: int,
) -> Arm:  # fmt: skip
    folder = out / "trials" / f"{name}-{start}"
    argv = [
        "eval",
        f"--env.type=roborecover_{study.platform}",
        f"--env.scenarios={study.scenarios}",
        f"--env.split={study.split}",
        f"--env.start={start}",
        *([f"--env.select=id={'|'.join(ids)}"] if ids else []),
        *(f"--env.{option}={value}" for option, value in sorted(study.env.items())),
        *policy,
        "--policy.device=cpu",
        f"--eval.n_episodes={trials}",
        # One observation a batch: an inference then rounds alike whoever else is waiting.
        "--runner.max_batch=1",
        f"--runner.slots={slots}",
        f"--env.trial_log={folder / 'trials.jsonl'}",
        f"--output_dir={folder}",
    ]
    return Arm(name, start, trials, tuple(argv), folder)
