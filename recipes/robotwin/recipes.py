"""The recipes of the RoboTwin starter set: which scene, which fault, and how it is labelled."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_roborecover.scenario import Source


@dataclass(frozen=True)
class Recipe:
    """One rollout that goes wrong."""

    task: str
    seed: int
    """RoboTwin's."""
    fault: str
    """A key of `FAULTS`."""
    noise_seed: int | None = None
    """Seed of the perturbation on every joint target; None leaves the driver's actions alone."""

    @property
    def id(self) -> str:
        """Scenario id."""
        noisy = "" if self.noise_seed is None else f"-noise{self.noise_seed}"
        return f"{self.task}-{self.seed}-{self.fault}{noisy}"

    @property
    def source(self) -> Source:
        """Perturbed where noise was added; else the driver's own failure."""
        return Source.NATURAL if self.noise_seed is None else Source.PERTURBED


def _recipes(task: str, fault: str, *seeds: int) -> tuple[Recipe, ...]:
    """The first seed without noise, the others with noise of the same seed."""
    return tuple(Recipe(task, seed, fault, None if k == 0 else seed) for k, seed in enumerate(seeds))


ELSEWHERE_ANOTHER_STATE = frozenset(
    {
        "blocks_ranking_rgb-4-drop",
        "stack_blocks_three-36-onto_wrong-noise36",
        "stack_blocks_three-38-topple-noise38",
        "stack_blocks_two-15-onto_wrong-noise15",
        "stack_blocks_two-16-beside-noise16",
        "stack_blocks_two-18-shove-noise18",
        "stack_blocks_two-46-onto_wrong-noise46",
        "stack_blocks_two-6-beside",
    }
)
"""Scenarios that end in another state on another processor, and so are not shipped: what falls or is pushed
amplifies a last bit that PhysX computes otherwise there."""

_RECORDED: tuple[Recipe, ...] = (
    *_recipes("stack_blocks_two", "knock", 0, 11, 17),
    *_recipes("stack_blocks_two", "misgrasp", 2, 3),
    *_recipes("stack_blocks_two", "press", 1, 13),
    *_recipes("stack_blocks_two", "drop", 4, 5),
    *_recipes("stack_blocks_two", "astray", 7, 14),
    *_recipes("stack_blocks_two", "onto_wrong", 36, 15, 46),
    *_recipes("stack_blocks_two", "beside", 6, 16),
    *_recipes("stack_blocks_two", "shove", 9, 18),
    *_recipes("stack_blocks_three", "wrong_block", 1, 2, 6),
    *_recipes("stack_blocks_three", "knock", 1, 24),
    *_recipes("stack_blocks_three", "misgrasp", 2, 25),
    *_recipes("stack_blocks_three", "onto_wrong", 46, 36),
    *_recipes("stack_blocks_three", "beside", 33),
    Recipe("stack_blocks_three", 38, "topple", 38),
    *_recipes("blocks_ranking_rgb", "astray", 2, 21),
    *_recipes("blocks_ranking_rgb", "press", 1, 22),
    *_recipes("blocks_ranking_rgb", "wrong_slot", 3, 23),
    *_recipes("blocks_ranking_rgb", "drop", 4),
    *_recipes("handover_block", "drop", 0, 1, 2),
    *_recipes("handover_block", "beside", 7, 8),
    *_recipes("blocks_ranking_size", "press", 2, 3),
    *_recipes("blocks_ranking_size", "wrong_slot", 4, 5),
    *_recipes("blocks_ranking_size", "drop", 6, 7),
    *_recipes("blocks_ranking_size", "knock", 8),
)

RECIPES = tuple(recipe for recipe in _RECORDED if recipe.id not in ELSEWHERE_ANOTHER_STATE)
"""What is shipped."""
