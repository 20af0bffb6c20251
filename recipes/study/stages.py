"""What making a study consists of: its stages, each one or more of the project's own commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from lerobot_roborecover.curation.pipeline.config import ChainConfig
from lerobot_roborecover.curation.screen.screening import ScreenRule
from lerobot_roborecover.datasets.lerobot_folder import local_repo_id
from lerobot_roborecover.datasets.load import builtin_names
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.workers.capacity import available_gb, default_slots, usable_cores
from recipes.study.recipe import StudyRecipe

CHECKPOINT = Path("checkpoints") / "last" / "pretrained_model"
"""Of a training's folder."""


@dataclass(frozen=True)
class StudyStage:
    """One step of making a study."""

    name: str
    commands: tuple[tuple[str, ...], ...]
    """Program and arguments, after `python -m`."""
    done: tuple[Path, ...]
    """All of them exist once the stage is finished."""
    partial: tuple[Path, ...] = ()
    """Results of an interrupted run that the commands would refuse to write over."""


def stages(out: Path, recipe: StudyRecipe, chain: ChainConfig, *, shipped: bool = False) -> list[StudyStage]:
    """The stages in their order; everything that they make lies below `out`.

    Args:
        out: working folder.
        recipe: how the study is made.
        chain: how its scenarios are built (`chain_for`).
        shipped: take the scenarios that come with the package. The trials that screened them do not, so the
            panel's policies are tried on the training split in their place.

    Raises:
        ScenarioError: `shipped`, and the recipe's set does not come with the package.
    """
    if shipped and recipe.dataset not in builtin_names():
        raise ScenarioError(
            f"set {recipe.dataset!r} of this study does not come with the package; these do: "
            f"{', '.join(builtin_names())}. Leave out --shipped-scenarios to build it"
        )

    def policy(name: str) -> str:
        return str(recipe.policy(out, name))

    screening = [str(p.name) for p in chain.screen.policies]
    trials = out / "panel_trials" if shipped else out / "scenarios" / "screened.trials"
    scenarios = recipe.dataset if shipped else str(out / "scenarios" / "split")
    settings = {**recipe.env, "snapshot_dir": str(out / "snapshots")}  # all runs share them

    def trials_of(path: str, count: int, folder: Path, *options: str) -> tuple[str, ...]:
        return _cli(
            "eval", "--env", f"roborecover_{recipe.platform}", f"--env.scenarios={scenarios}",
            "--env.split=train", *(f"--env.{n}={value}" for n, value in settings.items()),
            *options, f"--policy.path={path}", f"--eval.n_episodes={count}", f"--output_dir={folder}",
        )  # fmt: skip

    env = [part for name, value in settings.items() for part in ("--env", f"{name}={value}")]
    logs = [str(trials / name / "trials.jsonl") for name in screening]
    base_trials = out / "base_trials"
    # A base policy that was not used for screening has no trials yet.
    base_stage = StudyStage(
        "base trials",
        (trials_of(policy(recipe.base), recipe.policies[recipe.base], base_trials),),
        (base_trials / "eval_info.json",),
    )
    of_base = [] if recipe.base in screening else [base_stage]
    logs += [str(base_trials / "trials.jsonl")] if of_base else []
    donors: list[str] = []
    for part in (p for p in chain.screen.policies if p.name != recipe.base):
        # One trial says all of a policy that repeats itself, and screening has kept it.
        kept = ["--trials-from", str(trials / str(part.name)), "--deterministic"]
        donors += [*(kept if part.deterministic else ["--donor"]), str(part.path)]
    # Screening began with the trials that the monitor's data want, and stopped where a scenario was settled.
    continued = [
        word
        for part in chain.screen.policies
        for word in ("--policy", str(part.path), "--trials-from", str(trials / str(part.name)))
    ]
    built = [
        *(
            StudyStage(
                name,
                (_program(words, out / name),),
                (out / name / "meta" / "roborecover" / "candidates.json",),
                (out / name,),
            )
            for name, words in recipe.recordings.items()
        ),
        StudyStage(
            "scenarios",
            (_cli("curate", "build", str(out / Path(recipe.chain).name)),),
            (Path(scenarios),),
        ),
    ]
    noisy = chain.screen.trials or ScreenRule.trials
    panel = [
        StudyStage(
            "panel trials",
            tuple(
                trials_of(
                    str(p.path), 1 if p.deterministic else noisy, trials / str(p.name),
                    "--env.record_actions=true",
                )
                for p in chain.screen.policies
            ),
            tuple(trials / name / "eval_info.json" for name in screening),
        )
    ]  # fmt: skip
    workers = ("--num-workers", str(default_slots("cpu", usable_cores(), available_gb())))
    correction, monitor = out / "correction_training", out / "monitor_training"
    return [
        StudyStage(
            "policies",
            tuple(_program(words, out) for words in [recipe.train_policies] if words),
            tuple(recipe.policy(out, name) for name in recipe.policies),
        ),
        *(panel if shipped else built),
        *of_base,
        StudyStage(
            "donors",
            (_cli(
                "curate", "donors", *logs, "--scenarios", scenarios, "--base", policy(recipe.base), *donors,
                *env, "--out", str(out / "donors"), "--license", "Apache-2.0", *workers,
            ),),
            (out / "donors" / "meta" / "roborecover" / "donors.json",),
            (out / "donors",),
        ),
        StudyStage(
            "correction",
            (
                (recipe.train, f"--config_path={recipe.correction}", f"--policy.path={policy(recipe.base)}",
                 f"--dataset.repo_id={local_repo_id(out / 'donors')}", f"--dataset.root={out / 'donors'}",
                 f"--output_dir={correction}"),
                _cli("export-ema", str(correction / CHECKPOINT.parent), "--out", str(out / "correction")),
            ),
            (out / "correction",),
            (correction,),
        ),
        StudyStage(
            "monitor data",
            (_cli(
                "detect", "data", "--scenarios", scenarios, *env, "--split-by", "cluster",
                *continued,
                "--train-frames", "24000", "--balanced-frames", "2000", "--natural-frames", "6000",
                "--out", str(out / "monitor_data"), "--license", "Apache-2.0", *workers,
            ),),
            (out / "monitor_data" / "validation_natural",),
        ),
        StudyStage(
            "monitor",
            ((recipe.train, f"--config_path={recipe.monitor}",
              f"--dataset.root={out / 'monitor_data' / 'train'}", f"--output_dir={monitor}"),),
            (monitor / "checkpoints" / _last_step(Path(recipe.monitor)),),
            (monitor,),
        ),
        StudyStage(
            "monitor metrics",
            (_cli(
                "detect", "evaluate-frames", "--monitor", str(monitor / CHECKPOINT),
                "--data", str(out / "monitor_data" / "validation_balanced"),
                "--data", str(out / "monitor_data" / "validation_natural"),
                "--out", str(out / "monitor_report"),
            ),),
            (out / "monitor_report" / "metrics.json",),
        ),
    ]  # fmt: skip


def _last_step(config: Path) -> str:
    """LeRobot's name for the last checkpoint of a training: earlier ones are of a run that was cut short."""
    return f"{yaml.safe_load(config.read_text())['steps']:06d}"


def _program(words: Sequence[str], out: Path) -> tuple[str, ...]:
    module, *rest = words
    return (module, "--out", str(out), *rest)


def _cli(*argv: str) -> tuple[str, ...]:
    return ("lerobot_roborecover.cli.main", *argv)
