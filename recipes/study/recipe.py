"""How a study is made: `policies/study/NAME.yaml` of a checkout."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.curation.pipeline.config import read_options
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.scenario import ScenarioError
from recipes.study.definition import IN_CHECKOUT

RECIPES = IN_CHECKOUT


@dataclass
class StudyRecipe:
    """What a study is made of, and by which programs."""

    platform: str
    policies: dict[str, int]
    """Trials of each scenario in the evaluation, by name: one of a policy that repeats itself."""
    base: str
    """The policy that interventions are built around."""
    chain: str
    """The scenarios' recipe."""
    chain_root: str
    """The folder that it works in unless an option says otherwise."""
    dataset: str = ""
    """Name of the set that comes with the package, which the study names where its scenarios are the same."""
    env: dict[str, str] = field(default_factory=dict)
    """Options of the recovery env type."""
    interventions: list[str] = field(default_factory=list)
    policies_folder: str | None = None
    """Checkpoints that are there already;"""
    train_policies: list[str] = field(default_factory=list)
    """or the module, with arguments, that trains them."""
    recordings: dict[str, list[str]] = field(default_factory=dict)
    """Module and arguments of scripted operators, by the chain's folder for what they record."""
    train: str = "recipes.frames_in_memory"
    """`lerobot-train`, fed from memory: the same weights, sooner."""
    correction: str = "policies/train/correction_act.yaml"
    monitor: str = "policies/train/monitor_small.yaml"

    def policy(self, out: Path, name: str) -> Path:
        """Where a policy's checkpoint is or will be, with the study's working folder."""
        return (Path(self.policies_folder) if self.policies_folder else out / "policies") / name


def read_recipe(name: str) -> StudyRecipe:
    """A study's recipe by its name.

    Raises:
        ScenarioError: there is none here.
        OptionError: its file is not a recipe.
    """
    path = RECIPES / f"{name}.yaml"
    if not path.is_file():
        there = sorted(p.stem for p in RECIPES.glob("*.yaml"))
        if there:
            raise ScenarioError(f"no study {name!r:.80} can be made; there are {', '.join(there)}")
        raise ScenarioError(
            f"{path} is not here: a study is made in a checkout of the repository, whose top folder has the "
            "configurations of its training and of its scenarios"
        )
    recipe = read_options(StudyRecipe, path)
    if (recipe.policies_folder is None) != bool(recipe.train_policies):
        raise OptionError(f"{path}: give policies_folder, or train_policies; not both, and not neither")
    if recipe.base not in recipe.policies:
        raise OptionError(f"{path}: base {recipe.base!r} is not one of {', '.join(recipe.policies)}")
    return recipe
