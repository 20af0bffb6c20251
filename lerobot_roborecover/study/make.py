"""Makes a study from nothing but the packages: policies, scenarios, Correction, monitor. Hours on two cores.

Every stage is one of the project's own commands. A stage whose result is there is not run again, and each
command goes on by itself where it was stopped; so a rerun continues.
"""

from __future__ import annotations

import json
import shlex
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from lerobot_roborecover.curation.pipeline.config import ChainConfig, read_config
from lerobot_roborecover.datasets.load import builtin_names, load_scenarios
from lerobot_roborecover.journal import append_records
from lerobot_roborecover.policies.ship import ship
from lerobot_roborecover.rounding import KERNELS
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.study.child import run_module
from lerobot_roborecover.study.definition import StudyDefinition, read_definition, write_definition
from lerobot_roborecover.study.recipe import StudyRecipe, read_recipe
from lerobot_roborecover.trials.sizes import usable_cores
from lerobot_roborecover.whole import new_folder

_CHECKPOINT = Path("checkpoints") / "last" / "pretrained_model"


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

    def trials_of(path: str, count: int, folder: Path, *options: str) -> tuple[str, ...]:
        return _cli(
            "eval", "--env", f"roborecover_{recipe.platform}", f"--env.scenarios={scenarios}",
            "--env.split=train", *(f"--env.{n}={value}" for n, value in recipe.env.items()),
            *options, f"--policy.path={path}", f"--eval.n_episodes={count}", f"--output_dir={folder}",
        )  # fmt: skip

    env = [part for name, value in recipe.env.items() for part in ("--env", f"{name}={value}")]
    logs = [str(trials / name / "trials.jsonl") for name in screening]
    base_trials = out / "base_trials"
    # A base that had no say in screening has no trials yet.
    of_base = (
        []
        if recipe.base in screening
        else [
            StudyStage(
                "base trials",
                (trials_of(policy(recipe.base), recipe.policies[recipe.base], base_trials),),
                (base_trials / "eval_info.json",),
            )
        ]
    )
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
            (_cli("build", str(out / Path(recipe.chain).name)),),
            (Path(scenarios),),
        ),
    ]
    panel = [
        StudyStage(
            "panel trials",
            tuple(
                trials_of(
                    str(p.path), 1 if p.deterministic else chain.screen.trials or 5, trials / str(p.name),
                    "--env.record_actions=true",
                )
                for p in chain.screen.policies
            ),
            tuple(trials / name / "eval_info.json" for name in screening),
        )
    ]  # fmt: skip
    workers = ("--workers", str(usable_cores()))
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
                "donors", *logs, "--scenarios", scenarios, "--base", policy(recipe.base), *donors, *env,
                "--out", str(out / "donors"), "--license", "Apache-2.0", *workers,
            ),),
            (out / "donors" / "meta" / "roborecover" / "donors.json",),
            (out / "donors",),
        ),
        StudyStage(
            "correction",
            (
                (recipe.train, f"--config_path={recipe.correction}", f"--policy.path={policy(recipe.base)}",
                 "--dataset.repo_id=local/donors", f"--dataset.root={out / 'donors'}",
                 f"--output_dir={correction}"),
                _cli("export-ema", str(correction / _CHECKPOINT.parent), "--out", str(out / "correction")),
            ),
            (out / "correction",),
            (correction,),
        ),
        StudyStage(
            "monitor data",
            (_cli(
                "monitor-data", "--scenarios", scenarios, *env, "--split-by", "cluster",
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
                "eval-monitor", "--monitor", str(monitor / _CHECKPOINT),
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


def make(
    name: str,
    out: Path,
    only: Sequence[str] = (),
    say: Callable[[str], None] = print,
    *,
    shipped: bool = False,
) -> StudyDefinition | None:
    """Runs what is missing and puts the study together in `out/data`; None where stages are left out.

    Args:
        name: of its recipe.
        out: working folder; a rerun goes on there.
        only: names of stages; empty runs all.
        say: takes progress lines.
        shipped: take the scenarios that come with the package, as `stages`.

    Raises:
        ScenarioError: a command failed, or there is no such study or stage, or no such set.
    """
    recipe = read_recipe(name)
    todo = stages(out, recipe, chain_for(out, recipe), shipped=shipped)
    unknown = set(only) - {s.name for s in todo}
    if unknown:
        raise ScenarioError(f"no stage {sorted(unknown)}; there are {[s.name for s in todo]}")
    for number, stage in enumerate(todo, 1):
        where = f"[{number}/{len(todo)}] {stage.name}"
        if only and stage.name not in only:
            continue
        if all(path.exists() for path in stage.done):
            say(f"{where}: there already")
            continue
        for left in stage.partial:
            shutil.rmtree(left, ignore_errors=True)
        began = time.monotonic()
        for command in stage.commands:
            say(f"{where}: python -m {shlex.join(command)}")
            _run(command)
        minutes = (time.monotonic() - began) / 60
        say(f"{where}: {minutes:.1f} min")
        append_records(out / "stages.jsonl", {"stage": stage.name, "minutes": round(minutes, 1)})
    return None if only else assemble(out, recipe, shipped=shipped)


def chain_for(out: Path, recipe: StudyRecipe) -> ChainConfig:
    """The scenarios' recipe, written anew so that it works below `out`."""
    out.mkdir(parents=True, exist_ok=True)
    chain = Path(recipe.chain)
    (out / chain.name).write_text(chain.read_text().replace(recipe.chain_root, str(out)))
    return read_config(out / chain.name)


def assemble(out: Path, recipe: StudyRecipe, *, shipped: bool = False) -> StudyDefinition:
    """Copies what an evaluation needs into `out/data` and writes its definition; `shipped` as `stages`."""
    data = out / "data"
    with new_folder(data, replace=True) as folder:
        _assemble(out, recipe, folder, shipped=shipped)
    return read_definition(data)


def _assemble(out: Path, recipe: StudyRecipe, folder: Path, *, shipped: bool) -> None:
    ignore = shutil.ignore_patterns("train_config.json", "videos", "images", "*.html")
    for name in () if recipe.policies_folder else recipe.policies:
        shutil.copytree(recipe.policy(out, name), folder / "policies" / name, ignore=ignore)
    split, kept = out / "scenarios" / "split", Path("meta") / "roborecover"
    with_package = shipped or comes_with_the_package(split, recipe.dataset)
    if not with_package:
        shutil.copytree(split / kept, folder / "scenarios" / kept, ignore=ignore)
    ship(out / "correction", folder / "correction")
    shutil.copytree(out / "monitor_training" / _CHECKPOINT, folder / "monitor", ignore=ignore)
    for path in (*folder.glob("*/config.json"), *folder.glob("policies/*/config.json")):
        _forget_place(path)
    study = StudyDefinition(
        root=folder, platform=recipe.platform, policies=recipe.policies, base=recipe.base, env=recipe.env,
        interventions=tuple(recipe.interventions), environment=KERNELS,
        dataset=recipe.dataset if with_package else "",
        policies_folder=recipe.policies_folder or "",
    )  # fmt: skip
    write_definition(study)


def comes_with_the_package(made: Path, name: str) -> bool:
    """Whether the scenarios that were made, their names, cells and splits are those of a set of this name."""
    if name not in builtin_names():
        return False
    ours, theirs = ({(s.id, s.sha256(), s.cell, s.split) for s in load_scenarios(of)} for of in (made, name))
    return ours == theirs


def _forget_place(path: Path) -> None:
    """A checkpoint's config without the folder of this machine that its training began from."""
    config = json.loads(path.read_text())
    if config.get("pretrained_path"):
        path.write_text(json.dumps({**config, "pretrained_path": None}, indent=4))


def _program(words: Sequence[str], out: Path) -> tuple[str, ...]:
    module, *rest = words
    return (module, "--out", str(out), *rest)


def _cli(*argv: str) -> tuple[str, ...]:
    return ("lerobot_roborecover.cli.main", *argv)


def _run(command: Sequence[str]) -> None:
    module, *argv = command
    status = run_module(module, argv, KERNELS)
    if status:
        raise ScenarioError(
            f"`python -m {shlex.join(command)}` ended with status {status}; what it said is above. "
            "What had finished is kept: run the same command again"
        )
