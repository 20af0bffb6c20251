"""Study of when to intervene: a detector learns from forks where Correction gains.

It is compared with never intervening and always intervening on scenarios that nothing was learned from.
Plan and results: docs/studies/intervention_timing.md.

    python -m recipes.intervention_timing --platform libero --out outputs/intervention_timing
    python -m recipes.intervention_timing --platform metaworld --out outputs/intervention_timing_metaworld
    python -m recipes.intervention_timing --platform metaworld --out outputs/stored --stored

The training scenarios are divided, by what they share, into three parts. The first trains Correction
(`curate donors`, `lerobot-train`). On the second, the base's trials are forked with that Correction, and
detectors are fitted. The third sets their thresholds. Then every arm runs on the test scenarios, and the
report is written. Finished parts are skipped. `--store` keeps the outcomes with the code, `--stored` reports
those.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from lerobot_roborecover.analysis.pages.fork_gain import write_gains
from lerobot_roborecover.analysis.stats.fork_gain import fork_gains
from lerobot_roborecover.analysis.tables import to_text
from lerobot_roborecover.curation.split import start_of
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.datasets.lerobot_folder import local_repo_id
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.scenario import Scenario
from recipes.commands import evaluate, roborecover
from recipes.outcomes import OUTCOMES, store_logs, stored_logs
from recipes.training import Training

PARTS = {"donors": 0.45, "forks": 0.35, "thresholds": 0.2}
"""Shares of the training scenarios."""
DETECTORS = {"gain": "recovery_gain", "features": "policy_features", "elapsed": "elapsed"}
ALPHA = 0.1
"""Chance of a false alarm in a clean rollout that the thresholds allow."""
BASELINE = "direct"
ARMS = (BASELINE, "reversion", "correction", *DETECTORS)


@dataclass(frozen=True)
class Subject:
    """The base policy, its platform, and the policies whose recoveries Correction learns from."""

    scenarios: str
    base: Path
    """Deterministic: a trial of it is run once."""
    donors: tuple[Path, ...]
    """Deterministic policies whose recoveries Correction learns from."""
    fork_every: int
    """Control steps."""


_LIBERO = Path("policies/libero")
_METAWORLD = Path("policies/study/metaworld_study/policies")
SUBJECTS = {
    "libero": Subject(
        "libero_recovery_0", _LIBERO / "act_few",
        (_LIBERO / "act_recover_large", _LIBERO / "act_recover", _LIBERO / "act"), 90,
    ),
    "metaworld": Subject(
        "metaworld_recovery", _METAWORLD / "act",
        (_METAWORLD / "tdmpc", _METAWORLD / "act_few", _METAWORLD / "act_clean"), 30,
    ),
}  # fmt: skip


def divide(scenarios: Iterable[Scenario]) -> dict[str, list[str]]:
    """Ids by part; scenarios that begin alike are in one. Which one is drawn from how they begin."""
    found: dict[str, list[str]] = {part: [] for part in PARTS}
    for scenario in scenarios:
        at = int.from_bytes(hashlib.sha256(repr(start_of(scenario)).encode()).digest()[:8]) / 2**64
        for part, share in PARTS.items():
            if at < share:
                found[part].append(scenario.id)
                break
            at -= share
    return found


@dataclass(frozen=True)
class SteppingIn:
    """One platform's runs, all in one folder."""

    platform: str
    subject: Subject
    out: Path
    parts: dict[str, list[str]]

    def _snapshots(self, head: str = "") -> str:
        """The option that shares handoffs among policies: each is replayed once."""
        return f"{head}snapshot_dir={self.out / 'snapshots'}"

    @property
    def _watched(self) -> Path:
        """Where `detect evaluate` keeps trials, and finds those that were forked."""
        return self.out / "detectors.work"

    def trials(
        self,
        part: str,
        policy: Path,
        start: str = "recovery",
        ids: Iterable[str] | None = None,
        out: Path | None = None,
    ) -> Path:
        """Log of a policy's trials on a part of the training scenarios, or on some of it, one observation at
        a time, so that they can be forked."""
        return evaluate(
            self.platform, self.subject.scenarios, "train",
            out or self.out / "train" / part / policy.name,
            self._snapshots("--env."), "--runner.max_batch=1", f"--policy.path={policy}", start=start,
            ids=self.parts[part] if ids is None else ids,
        )  # fmt: skip

    def correction(self) -> Path:
        """Trained on the donors' part."""
        made = self.out / "correction"
        if made.exists():
            return made
        donors, base = self.out / "donors", self.subject.base
        if not (donors / "meta" / "roborecover" / "donors.json").exists():
            # Of a run that was cut short; its trials are kept beside it.
            shutil.rmtree(donors, ignore_errors=True)
            logs = {base: self.trials("donors", base)}
            lost = [row.scenario_id for row in read_trial_log(logs[base]) if not row.success]
            logs |= {policy: self.trials("donors", policy, ids=lost) for policy in self.subject.donors}
            named = [
                word
                for policy in self.subject.donors
                for word in ("--trials-from", logs[policy].parent, "--deterministic", policy)
            ]
            roborecover(
                "curate", "donors", *logs.values(), "--scenarios", self.subject.scenarios, "--base", base,
                *named, "--env", "obs_type=state", "--license", "Apache-2.0", "--out", donors,
            )  # fmt: skip
        training = Training(
            Path("policies/train/correction_act.yaml"), donors, self.out / "correction_training",
            options=(f"--policy.path={base}", f"--dataset.repo_id={local_repo_id(donors)}"),
        )  # fmt: skip
        roborecover("export-ema", training.train(), "--out", made)
        return made

    def forks(self, correction: Path) -> Path:
        """Of the base's trials on the forks' part, from recovery points and from the start."""
        logs = [
            self.trials("forks", self.subject.base, start, out=self._watched / f"train-{start}")
            for start in ("recovery", "initial")
        ]
        out = self.out / "forks"
        roborecover(
            "detect", "fork", *logs, "--policy", self.subject.base, "--deterministic",
            "--arm", f"correction:{correction}", "--stride", str(self.subject.fork_every),
            "--env", self._snapshots(), "--out", out,
        )  # fmt: skip
        return out

    def detectors(self, forks: Path) -> Path:
        """Fitted on the forks' part, thresholds of the third."""
        out = self.out / "detectors"
        named = [word for name, what in DETECTORS.items() for word in ("--detector", f"{name}={what}")]
        roborecover(
            "detect", "evaluate", "--scenarios", self.subject.scenarios, "--policy", self.subject.base,
            "--env", "obs_type=state", "--env", self._snapshots(), *named, "--forks", forks,
            "--split", "train",
            "--select", f"id={'|'.join(self.parts['thresholds'])}", "--fit-split", "train",
            "--fit-select", f"id={'|'.join(self.parts['forks'])}", "--alpha", str(ALPHA),
            "--frame-strips", "0",
            "--num-workers", "2", "--work", self._watched, "--out", out,
        )  # fmt: skip
        return out / "detectors"

    def arm(self, name: str, *options: str) -> Path:
        """Runs one arm on the test scenarios; returns its trial log."""
        return evaluate(
            self.platform, self.subject.scenarios, "test", self.out / "test" / name,
            self._snapshots("--env."), "--policy.type=roborecover_intervention",
            f"--policy.base.path={self.subject.base}", *options,
        )  # fmt: skip

    def run(self) -> dict[str, Path]:
        """Runs everything; returns the arms' trial logs."""
        correction = self.correction()
        detectors = self.detectors(self.forks(correction))
        by_correction = f"--policy.correction.path={correction}"
        logs = {
            BASELINE: self.arm(BASELINE, "--policy.mode=direct"),
            "reversion": self.arm("reversion", "--policy.mode=reversion"),
            "correction": self.arm("correction", "--policy.mode=correction", by_correction),
        }
        for name in DETECTORS:
            monitor = f"--policy.monitor.path={detectors / name}"
            logs[name] = self.arm(name, "--policy.mode=monitor_correction", by_correction, monitor)
        return logs


def stored_folder(platform: str) -> Path:
    """Returns the folder of a platform's stored outcomes."""
    return OUTCOMES / f"intervention_timing_{platform}"


def report(logs: Mapping[str, Path], out: Path) -> None:
    """Writes and prints the report on the arms' trial logs."""
    named = [f"{name}={log}" for name, log in logs.items()]
    roborecover("report", *named, "--baseline", BASELINE, "--out", out / "report")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--platform", choices=SUBJECTS, default="libero", help="(%(default)s)")
    add("--out", type=Path, required=True, help="folder to work in; a rerun goes on there")
    add("--scenarios", help="another set of the platform, with the splits train and test")
    add("--stride", "--every", dest="every", type=int, help="fork every so many steps")
    add("--store", action="store_true", help="keep the outcomes with the code")
    add(
        "--use-stored-outcomes", "--stored", dest="stored", action="store_true",
        help="run nothing: report the outcomes kept with the code",
    )  # fmt: skip
    args = parser.parse_args()
    if args.stored:
        stored = stored_logs(stored_folder(args.platform))
        report({name: stored[name] for name in ARMS}, args.out)
        gains = fork_gains(read_trial_log(stored["forks"]))
        tables = write_gains(gains, args.out / "forks", "python -m recipes.intervention_timing --stored")
        print("\n".join(to_text(table) for table in tables[:2]))
        return
    subject = SUBJECTS[args.platform]
    if not subject.base.is_dir():
        parser.error(
            f"{subject.base} is not here: run this in the top folder of a checkout of the repository"
        )
    subject = replace(
        subject, scenarios=args.scenarios or subject.scenarios, fork_every=args.every or subject.fork_every
    )
    parts = divide(load_scenarios(subject.scenarios, split="train"))
    print(
        f"training scenarios: {', '.join(f'{len(ids)} for {part}' for part, ids in parts.items())}",
        flush=True,
    )
    run = SteppingIn(args.platform, subject, args.out, parts)
    logs = run.run()
    if args.store:
        store_logs(logs | {"forks": run.out / "forks" / "trials.jsonl"}, stored_folder(args.platform))
    report(logs, args.out)


if __name__ == "__main__":
    main()
