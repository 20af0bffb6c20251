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
from pathlib import Path

from lerobot_roborecover.curation.pipeline.config import ChainConfig, read_config
from lerobot_roborecover.datasets.load import builtin_names, load_scenarios
from lerobot_roborecover.evaluation.arms import run_program, this_module
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir, atomic_write
from lerobot_roborecover.utils.determinism import KERNELS
from lerobot_roborecover.utils.journal import append_records
from recipes.ship import ship
from recipes.study.definition import StudyDefinition, read_definition, write_definition
from recipes.study.recipe import StudyRecipe, read_recipe
from recipes.study.stages import CHECKPOINT, stages


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
    atomic_write(out / chain.name, chain.read_text().replace(recipe.chain_root, str(out)))
    return read_config(out / chain.name)


def assemble(out: Path, recipe: StudyRecipe, *, shipped: bool = False) -> StudyDefinition:
    """Copies what an evaluation needs into `out/data` and writes its definition; `shipped` as `stages`."""
    data = out / "data"
    with atomic_dir(data, replace=True) as folder:
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
    shutil.copytree(out / "monitor_training" / CHECKPOINT, folder / "monitor", ignore=ignore)
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


def _run(command: Sequence[str]) -> None:
    module, *argv = command
    status = run_program([*this_module(module), *argv], KERNELS)
    if status:
        raise ScenarioError(
            f"`python -m {shlex.join(command)}` ended with status {status}; what it said is above. "
            "What had finished is kept: run the same command again"
        )
