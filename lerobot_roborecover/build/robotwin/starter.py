"""Makes the RoboTwin starter set: scripted rollouts that go wrong, each proven recoverable by the expert.

    ROBOTWIN_ROOT=<checkout> python -m lerobot_roborecover.build.robotwin.starter --out DIR

Deterministic: a second run on the same checkout gives the same set bit for bit.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from lerobot_roborecover.build.robotwin.expert import BlockExpert
from lerobot_roborecover.build.robotwin.recipes import FAULTS, INSTRUCTIONS, RECIPES, TOWERS, Recipe, drive
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.replay import hand_off, with_fingerprint
from lerobot_roborecover.scenario import Reset, Scenario, ScenarioError, Task
from lerobot_roborecover.simulators import SimulatorError
from lerobot_roborecover.simulators.robotwin import RobotwinSimulator
from lerobot_roborecover.simulators.robotwin_limits import STEP_LIMITS

TASK_CONFIG = "demo_clean"
NOISE_RAD = 0.03
"""Half-width of the uniform noise on every joint target of a perturbed rollout."""
_DESCRIPTION = (
    "RoboRecover starter set for RoboTwin 2.0: recovery points from rollouts of a scripted joint-space "
    "driver that goes wrong, with and without noise on its actions, each proven recoverable. Not the paper's "
    "scenarios."
)
_MOVED_M = 0.02


def task_of(recipe: Recipe) -> Task:
    """The recipe's task with RoboTwin's official limit."""
    instruction = INSTRUCTIONS[recipe.task]
    return Task("robotwin", TASK_CONFIG, recipe.task, instruction, STEP_LIMITS[recipe.task])


def roll_out(simulator: RobotwinSimulator, recipe: Recipe) -> np.ndarray:
    """(T, 14) float64: the actions of the recipe's driver up to its recovery point.

    Raises:
        ScenarioError: the driver solves the task.
    """
    rng = None if recipe.noise_seed is None else np.random.default_rng(recipe.noise_seed)
    simulator.reset(task_of(recipe), Reset(seed=recipe.seed))
    actions = []
    for action in drive(BlockExpert(simulator), recipe):
        if rng is not None:
            action[:6] += rng.uniform(-NOISE_RAD, NOISE_RAD, 6)
            action[7:13] += rng.uniform(-NOISE_RAD, NOISE_RAD, 6)
        simulator.step(action)
        actions.append(action)
        if simulator.succeeded():
            raise ScenarioError(f"recipe {recipe.id}: the driver solves the task at step {len(actions)}")
    return np.array(actions, dtype=np.float64)


def prove(simulator: RobotwinSimulator, scenario: Scenario) -> int | None:
    """Steps the expert needs from the handoff, or None where it does not make it within the budget."""
    handoff = hand_off(simulator, scenario)
    if handoff.problem is not None:
        raise ScenarioError(f"scenario {scenario.id}: {handoff.reason}")
    expert = BlockExpert(simulator)
    try:
        for step, action in enumerate(expert.recover(list(TOWERS[scenario.task.name])), start=1):
            simulator.step(action)
            if simulator.succeeded():
                return step
            if step == scenario.task.horizon:
                return None
    except RuntimeError:  # out of reach
        return None
    return None


def make(simulator: RobotwinSimulator, recipe: Recipe) -> Scenario:
    """One scenario from its recipe, with fingerprint and proof.

    Raises:
        ScenarioError: the driver solves the task, nothing has happened to the scene, or the expert cannot
            recover.
        RuntimeError: the driver cannot reach what it should.
    """
    fault = FAULTS[recipe.fault]
    scenario = with_fingerprint(
        simulator,
        Scenario(
            id=recipe.id,
            task=task_of(recipe),
            reset=Reset(seed=recipe.seed),
            prefix=roll_out(simulator, recipe),
            stage=fault.stage,
            deviation=fault.deviation,
            source=recipe.source,
            source_policy="joint-expert",
            cluster=f"{recipe.task}:{recipe.seed}",
        ),
    )
    after = scenario.fingerprint.bodies
    simulator.reset(scenario.task, scenario.reset)
    before = simulator.bodies()
    moved = {
        name: round(pose.distance_m(after[name]), 3)
        for name, pose in before.items()
        if not name.startswith("eef") and pose.distance_m(after[name]) > _MOVED_M
    }
    if not moved and recipe.fault != "misgrasp":
        raise ScenarioError(f"recipe {recipe.id}: no block has moved by {_MOVED_M * 1e3:g} mm or more")
    steps = prove(simulator, scenario)
    if steps is None:
        raise ScenarioError(f"recipe {recipe.id}: the expert does not recover")
    provenance = {
        "made_by": "lerobot_roborecover.build.robotwin.starter",
        "sees": fault.sees,
        "noise_seed": recipe.noise_seed,
        "noise_rad": None if recipe.noise_seed is None else NOISE_RAD,
        "moved_m": moved,
        "robotwin_commit": simulator.checkout.commit,
        "proof": {"controller": "joint-expert", "steps": steps},
    }
    return replace(scenario, provenance=provenance)


_simulator: RobotwinSimulator | None = None
"""A worker process's own."""


def _attempt(root: str | None, recipe: Recipe) -> Scenario | str:
    """A scenario, or why there is none; runs in a worker process."""
    global _simulator
    _simulator = _simulator or RobotwinSimulator(root, obs_type="state")
    try:
        return make(_simulator, recipe)
    except (ScenarioError, SimulatorError, RuntimeError) as err:
        return str(err)


def main(argv: list[str] | None = None) -> int:
    """Runs the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m lerobot_roborecover.build.robotwin.starter")
    parser.add_argument("--out", type=Path, required=True, help="dataset folder to write")
    parser.add_argument("--only", default="", help="make only the recipes whose id contains this")
    parser.add_argument("--robotwin-root", default=None, help="RoboTwin checkout; default $ROBOTWIN_ROOT")
    parser.add_argument("--jobs", type=int, default=2, help="simulators at work at once")
    args = parser.parse_args(argv)
    scenarios, problems = [], 0
    recipes = [recipe for recipe in RECIPES if args.only in recipe.id]
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        made = pool.map(partial(_attempt, args.robotwin_root), recipes)
        for k, (recipe, scenario) in enumerate(zip(recipes, made, strict=True), start=1):
            if isinstance(scenario, str):
                problems += 1
                print(f"[{k}/{len(recipes)}] {recipe.id}: {scenario}", file=sys.stderr, flush=True)
                continue
            steps = scenario.provenance["proof"]["steps"]
            print(
                f"[{k}/{len(recipes)}] {recipe.id}: {scenario.cell}, {len(scenario.prefix)} actions, "
                f"recovered in {steps}",
                flush=True,
            )
            scenarios.append(scenario)
    if scenarios:
        write_scenarios(args.out, scenarios, description=_DESCRIPTION, license="Apache-2.0")
        print(f"wrote {len(scenarios)} scenarios to {args.out}; {problems} recipes failed")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
