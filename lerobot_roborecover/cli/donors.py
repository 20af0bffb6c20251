"""`roborecover curate donors`."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

from lerobot_roborecover.cli.export_training import TrainingSetOptions
from lerobot_roborecover.curation.donors import DonorOptions
from lerobot_roborecover.utils.determinism import pin_policy_kernels
from lerobot_roborecover.utils.options import option

HELP = (
    "Make the dataset that Correction is trained on: other policies' recoveries of training scenarios that "
    "the base policy does badly on."
)
MANIFEST_FILE = "donors.json"


@dataclass(frozen=True, kw_only=True)
class DonorDataOptions(TrainingSetOptions):
    """Which trials donate, and what is written."""

    logs: tuple[Path, ...] = option(positional=True)
    """Trial logs of the base and of the alternatives."""
    base: str
    """The base policy: its checkpoint, or its name in the logs."""
    donors: tuple[str, ...] = option((), name="donor", metavar="CHECKPOINT", checkpoint=True)
    """An alternative that is in the logs: run its four trials; give it again for each."""
    trials_from: tuple[Path, ...] = option((), metavar="DIR")
    """Trials with their actions, as an earlier run left them in its --work: read instead of run."""
    work: Path | None = None
    """Folder of the donors' trials, kept between runs (OUT.trials)."""
    rule: DonorOptions = field(default_factory=DonorOptions)
    run_seed: int = 2000
    """Run seed of the donors' trials."""
    device: str | None = None
    """Device of the donors."""
    statistics_of: str | None = option(None, metavar="CHECKPOINT")
    """Normalise as this checkpoint does, whose training goes on here (default: the base, where --base is a
    checkpoint's folder)."""


OPTIONS = DonorDataOptions


def run(options: DonorDataOptions) -> int:
    """Chooses, runs, judges, writes; prints the funnel."""
    pin_policy_kernels()  # outcomes of these trials are compared with those of a study
    from lerobot_roborecover.analysis.stats.labels import tell_settings_apart
    from lerobot_roborecover.curation import donors
    from lerobot_roborecover.curation.funnel import StageCounts
    from lerobot_roborecover.curation.normalisation import use_statistics_of
    from lerobot_roborecover.curation.policy_trials import env_config, read_trials, run_trials
    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.datasets.schema import FOLDER
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.logs.trial_log import read_trial_log
    from lerobot_roborecover.policies.identity import policy_identity
    from lerobot_roborecover.utils.atomic_io import atomic_write, check_new
    from lerobot_roborecover.utils.progress import Progress

    check_new(options.out)
    rows = [row for log in options.logs for row in read_trial_log(log)]
    tell_settings_apart(rows)
    names = {row.policy for row in rows}
    base, *alike = (
        p if p in names else policy_identity(p) for p in (options.base, *options.rule.deterministic)
    )
    trials = [t for folder in options.trials_from for t in read_trials(folder)]
    given = {policy_identity(checkpoint) for checkpoint in options.donors} | {t.row.policy for t in trials}
    stray = sorted(set(alike) - given)
    if stray:
        raise OptionError(
            f"--deterministic {' '.join(stray)}: neither a --donor, nor one whose trials are in "
            f"--trials-from; these are {', '.join(sorted(given)) or 'none'}"
        )
    rule = replace(options.rule, deterministic=tuple(alike))
    scenarios = load_scenarios(options.scenarios, revision=options.revision, split=options.split)
    funnel: list[StageCounts] = []
    donors.add_step(funnel, f"scenarios of split {options.split}", len(scenarios))
    candidates = donors.choose_candidates(scenarios, rows, base, rule, funnel)
    work = options.work or options.out.with_name(f"{options.out.name}.trials")
    progress = Progress("trial")
    for number, checkpoint in enumerate(options.donors):
        name = policy_identity(checkpoint)
        ids = [c.scenario.id for c in candidates if c.policy == name]
        if not ids:
            print(f"{checkpoint}: no candidate is by {name}", file=sys.stderr)
            continue
        which = [f"--split={options.split}", f"--select=id={'|'.join(ids)}"]
        which += [f"--revision={options.revision}"] if options.revision else []
        env = env_config(scenarios.platform, options.scenarios, [*which, *(f"--{o}" for o in options.env)])
        trials += run_trials(
            checkpoint, env, work / f"{number}-{name.replace('/', '--')}", trials=rule.trials_of(name),
            seed=options.run_seed, device=options.device,
            on_row=lambda row, done, total: progress.of(f"trials of {row.policy}", done, total),
        )  # fmt: skip
    passed = donors.judge(candidates, trials, rule, funnel)
    chosen = donors.deduplicate(passed, rule, funnel)
    spec = env_config(scenarios.platform, options.scenarios, [f"--{o}" for o in options.env]).run_spec()

    def finish(folder: Path) -> None:
        if options.statistics_of or Path(options.base).is_dir():
            use_statistics_of(folder, Path(options.statistics_of or options.base))
        note = donors.describe(rule, base, funnel)
        atomic_write(folder / FOLDER / MANIFEST_FILE, json.dumps(note, indent=1) + "\n")

    donors.write_donors(
        options.out, chosen, simulator=spec.slot.options, workers=options.num_workers, funnel=funnel,
        description=f"Recoveries by other policies where {base} fails, for Correction.",
        license=options.license,
        on_trajectory=Progress("replay"), also=finish,
    )  # fmt: skip
    print(donors.funnel_table(funnel))
    print(
        f"\nlerobot-train --config_path={_training_config(options.base)} "
        f"--policy.path={_checkpoint(options.base)} --dataset.repo_id=local/donors "
        f"--dataset.root={options.out} --output_dir=correction"
    )
    return 0


def _training_config(base: str) -> str:
    """Returns the shipped training configuration of the base's type, which a folder tells."""
    try:
        kind = json.loads((Path(base) / "config.json").read_text()).get("type")
    except (OSError, ValueError):
        kind = None
    return f"policies/train/correction_{kind if kind in ('act', 'pi05', 'smolvla') else '<type>'}.yaml"


def _checkpoint(base: str) -> str:
    """Returns the base as `lerobot-train` takes it; a name in the logs (NAME@HASH) is none."""
    return base if Path(base).is_dir() or "@" not in base else "<checkpoint>"
