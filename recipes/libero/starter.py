"""Makes the LIBERO starter set: real rollouts that went wrong, each proven recoverable by the expert.

    python -m recipes.libero.starter --out DIR

What went wrong, and where each recovery point lies, was decided by looking at the frames; the table is in
`recipes`. Everything is deterministic, so that a second run gives the same set bit for bit; what is
finished is kept in `DIR.parts`, so that a run can be interrupted.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from lerobot_roborecover.curation.rollout import record
from lerobot_roborecover.datasets import read_scenarios, write_scenarios
from lerobot_roborecover.platforms.libero.catalog import LIBERO_HORIZONS, libero_instruction, libero_tasks
from lerobot_roborecover.platforms.libero.expert import Flaws, LiberoExpert
from lerobot_roborecover.platforms.libero.platform import PLATFORM
from lerobot_roborecover.platforms.libero.scene import LiberoScene
from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator
from lerobot_roborecover.platforms.simulator import is_mark
from lerobot_roborecover.replay.handoff import hand_off, with_fingerprint
from lerobot_roborecover.replay.recorder import PERTURBED, Recorder, Steps
from lerobot_roborecover.scenario import Reset, Scenario, ScenarioError, Task
from recipes.libero.recipes import RECIPES, Recipe

SEED = 7
"""Of every reset (the paper's release)."""
_MOVED_M = 0.02
_DESCRIPTION = (
    "Starter set for LIBERO: recovery points from rollouts of scripted drivers, with and without the paper's "
    "action perturbation, each proven recoverable by the scripted expert. Not the paper's scenarios."
)


def task_of(recipe: Recipe) -> Task:
    """The recipe's task with the paper's budget."""
    name = libero_tasks()[recipe.suite][recipe.task]
    return Task("libero", recipe.suite, name, libero_instruction(name), LIBERO_HORIZONS[recipe.suite])


def roll_out(simulator: LiberoSimulator, recipe: Recipe, steps: int | None = None) -> Recorder:
    """Drives the recipe's flawed driver, under the perturbation where it has one.

    Args:
        simulator: reset here.
        recipe: what to drive.
        steps: actions after settling; None for the task's whole budget, to see that the failure lasts.
    """
    task = task_of(recipe)
    reset = Reset(seed=SEED, init_state_index=recipe.init, settle_steps=PLATFORM.settle_steps)
    driver: list[LiberoExpert] = []

    def act(t: int) -> np.ndarray:
        if t == 0:
            driver.append(LiberoExpert(LiberoScene(simulator), recipe.flaws))
        return driver[0].act()

    rng = None if recipe.noise_seed is None else np.random.default_rng(recipe.noise_seed)
    return record(
        simulator,
        task,
        reset,
        act,
        steps=steps or task.horizon,
        settle_action=PLATFORM.no_op(),
        perturb=rng,
    )


def prove(simulator: LiberoSimulator, scenario: Scenario) -> int | None:
    """Steps the expert needs from the handoff, or None where it does not make it within the budget."""
    handoff = hand_off(simulator, scenario)
    if handoff.problem is not None:
        raise ScenarioError(f"scenario {scenario.id}: {handoff.reason}")
    expert = LiberoExpert(LiberoScene(simulator))
    for step in range(1, scenario.task.horizon + 1):
        simulator.step(expert.act())
        if simulator.succeeded():
            return step
    return None


def make(simulator: LiberoSimulator, recipe: Recipe) -> Scenario:
    """One scenario from its recipe, with fingerprint and proof.

    Raises:
        ScenarioError: the rollout solves the task, or the expert cannot recover.
    """
    driven = roll_out(simulator, recipe)
    if any(driven.solved):
        raise ScenarioError(
            f"recipe {recipe.id}: the driver solves the task at step {driven.solved.index(True)}"
        )
    rollout = driven.rollout
    scenario = Scenario(
        id=recipe.id,
        task=rollout.task,
        reset=rollout.reset,
        prefix=rollout.actions[: recipe.step],
        stage=recipe.stage,
        deviation=recipe.deviation,
        source=recipe.source,
        source_policy=recipe.driver,
        cluster=recipe.id,
    )
    scenario = with_fingerprint(simulator, scenario)
    steps = prove(simulator, scenario)
    if steps is None:
        raise ScenarioError(
            f"recipe {recipe.id}: the expert does not recover in {rollout.task.horizon} steps"
        )
    return replace(scenario, provenance=_provenance(recipe, driven.steps, steps))


def _provenance(recipe: Recipe, seen: Steps, proof_steps: int) -> dict:
    flaws = {k: v for k, v in asdict(recipe.flaws).items() if v != getattr(Flaws(), k)}
    moved = {}
    for body, poses in seen.bodies.items():
        path = poses[: recipe.step + 1, :3]
        distance = float(np.linalg.norm(path[-1] - path[PLATFORM.settle_steps]))
        if not (body.startswith("eef") or is_mark(body)) and distance > _MOVED_M:
            moved[body] = round(distance, 3)
    return {
        "made_by": "recipes.libero.starter",
        "recipe": digest(recipe),
        "sees": recipe.sees,
        "driver_flaws": flaws,
        "noise_seed": recipe.noise_seed,
        "perturbed_steps": int((seen.perturbation[: recipe.step] == PERTURBED).sum()),
        "moved_m": moved,
        "failure_lasts_steps": len(seen.perturbation) - recipe.step,
        "proof": {"controller": "scripted-expert", "steps": proof_steps},
    }


def digest(recipe: Recipe) -> str:
    """Short hash of a recipe, by which finished parts are recognised."""
    return hashlib.sha256(repr(recipe).encode()).hexdigest()[:16]


def finished(part: Path, recipe: Recipe) -> Scenario | None:
    """The scenario an earlier run made from this very recipe, or None."""
    if not part.is_dir():
        return None
    scenario = read_scenarios(part)[0]
    return scenario if scenario.provenance.get("recipe") == digest(recipe) else None


def main(argv: list[str] | None = None) -> int:
    """Runs the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m recipes.libero.starter")
    parser.add_argument("--out", type=Path, required=True, help="dataset folder to write")
    parser.add_argument(
        "--only", default="", help="make only the recipes whose id contains this; writes no set"
    )
    parser.add_argument("--assets-dir", default=None, help="LIBERO's assets")
    args = parser.parse_args(argv)
    parts = args.out.with_name(f"{args.out.name}.parts")
    simulator = LiberoSimulator(assets_dir=args.assets_dir, obs_type="state")
    scenarios, problems = [], 0
    recipes = [r for r in RECIPES if args.only in r.id]
    for k, recipe in enumerate(recipes, start=1):
        scenario = finished(parts / recipe.id, recipe)
        verdict = "kept"
        if scenario is None:
            try:
                scenario = make(simulator, recipe)
            except ScenarioError as err:
                problems += 1
                print(f"[{k}/{len(recipes)}] {recipe.id}: {err}", file=sys.stderr, flush=True)
                continue
            write_scenarios(parts / recipe.id, [scenario])
            verdict = "made"
        proof = scenario.provenance["proof"]["steps"]
        print(
            f"[{k}/{len(recipes)}] {recipe.id}: {verdict}, {scenario.cell}, recovered in {proof}", flush=True
        )
        scenarios.append(scenario)
    simulator.close()
    if problems:
        print(f"{problems} recipes failed; no set was written", file=sys.stderr)
        return 1
    if not args.only:
        write_scenarios(args.out, scenarios, description=_DESCRIPTION, license="Apache-2.0")
        print(f"wrote {len(scenarios)} scenarios to {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
