"""Makes the RoboTwin starter set: scripted rollouts that go wrong, each proven recoverable by the expert.

    ROBOTWIN_ROOT=<checkout> python -m recipes.robotwin.starter --out DIR

Deterministic: a second run on the same checkout gives the same set bit for bit.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from lerobot_roborecover.datasets import load_scenarios, write_scenarios
from lerobot_roborecover.platforms import SimulatorError
from lerobot_roborecover.platforms.robotwin.platform import STEP_LIMITS
from lerobot_roborecover.platforms.robotwin.simulator import RobotwinSimulator
from lerobot_roborecover.replay.handoff import with_fingerprint
from lerobot_roborecover.replay.recorder import Recorder
from lerobot_roborecover.scenario import Reset, Scenario, ScenarioError, Task
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.workers.jobs import JobPool, simulator_of_worker
from recipes.robotwin.expert import BlockExpert
from recipes.robotwin.faults import FAULTS, drive
from recipes.robotwin.plans import INSTRUCTIONS, recover
from recipes.robotwin.recipes import RECIPES, Recipe

TASK_CONFIG = "demo_clean"
NOISE_RAD = 0.03
"""Half-width of the uniform noise on every joint target of a perturbed rollout."""
_DESCRIPTION = (
    "RoboRecover starter set for RoboTwin 2.0: recovery points from rollouts of a scripted joint-space "
    "driver that goes wrong, with and without noise on its actions, each proven recoverable. Not the paper's "
    "scenarios."
)
_MOVED_M = 0.02
PROOF_STEP_RAD = 0.24
"""Largest joint motion of one action of a proof."""


def task_of(recipe: Recipe) -> Task:
    """The recipe's task with RoboTwin's official limit."""
    instruction = INSTRUCTIONS[recipe.task]
    return Task("robotwin", TASK_CONFIG, recipe.task, instruction, STEP_LIMITS[recipe.task])


def roll_out(simulator: RobotwinSimulator, recipe: Recipe) -> Recorder:
    """The recipe's driver, recorded up to its recovery point.

    Raises:
        ScenarioError: the driver solves the task.
    """
    rng = None if recipe.noise_seed is None else np.random.default_rng(recipe.noise_seed)
    recorder = Recorder(simulator)
    recorder.reset(task_of(recipe), Reset(seed=recipe.seed))
    for action in drive(BlockExpert(simulator), recipe.task, recipe.fault, recipe.seed):
        if rng is not None:
            action[:6] += rng.uniform(-NOISE_RAD, NOISE_RAD, 6)
            action[7:13] += rng.uniform(-NOISE_RAD, NOISE_RAD, 6)
        recorder.step(action)
        if recorder.solved[-1]:
            raise ScenarioError(f"recipe {recipe.id}: the driver solves the task at step {len(recorder)}")
    return recorder


def prove(simulator: RobotwinSimulator, task: Task) -> int | None:
    """Steps the expert needs from a handoff, or None where it does not make it within the budget."""
    expert = BlockExpert(simulator, PROOF_STEP_RAD)
    try:
        for step, action in enumerate(recover(expert, task.name), start=1):
            simulator.step(action)
            if simulator.succeeded():
                return step
            if step == task.horizon:
                return None
    except RuntimeError:  # out of reach
        return None
    return None


def make(simulator: RobotwinSimulator, recipe: Recipe) -> Scenario:
    """One scenario from its recipe, with fingerprint and proof.

    Raises:
        ScenarioError: the driver solves the task, nothing has happened to the scene, the replay differs from
            the rollout, or the expert cannot recover.
        RuntimeError: the driver cannot reach what it should.
    """
    fault = FAULTS[recipe.fault]
    task = task_of(recipe)
    driven = roll_out(simulator, recipe)
    before, rollout = driven.bodies[0], driven.rollout
    rolled_out = simulator.state_sha256()
    scenario = with_fingerprint(
        simulator,
        Scenario(
            id=recipe.id,
            task=task,
            reset=rollout.reset,
            prefix=rollout.actions,
            stage=fault.stage,
            deviation=fault.deviation,
            source=recipe.source,
            source_policy="joint-expert",
            cluster=f"{recipe.task}:{recipe.seed}",
        ),
    )
    after = scenario.fingerprint
    if after.state_sha256 != rolled_out:
        raise ScenarioError(f"recipe {recipe.id}: the replay ends in another state than the rollout")
    moved = {
        name: round(pose.distance_m(after.bodies[name]), 3)
        for name, pose in before.items()
        if not name.startswith("eef") and pose.distance_m(after.bodies[name]) > _MOVED_M
    }
    if fault.touches and not moved:
        raise ScenarioError(f"recipe {recipe.id}: no block has moved by {_MOVED_M * 1e3:g} mm or more")
    steps = prove(simulator, task)
    if steps is None:
        raise ScenarioError(f"recipe {recipe.id}: the expert does not recover")
    provenance = {
        "made_by": "recipes.robotwin.starter",
        "sees": fault.words(recipe.task),
        "noise_seed": recipe.noise_seed,
        "noise_rad": None if recipe.noise_seed is None else NOISE_RAD,
        "moved_m": moved,
        "robotwin_commit": simulator.checkout.commit,
        "proof": {"controller": "joint-expert", "steps": steps},
    }
    return replace(scenario, provenance=provenance)


def _attempt(work: Path, recipe: Recipe) -> Scenario | str:
    """A scenario, or why there is none; runs in a worker process, which keeps what it made in `work`."""
    kept, refused = work / "made" / recipe.id, work / "refused" / f"{recipe.id}.txt"
    if kept.is_dir():
        return next(iter(load_scenarios(kept)))
    if refused.is_file():
        return refused.read_text(encoding="utf-8")
    simulator = simulator_of_worker()
    assert isinstance(simulator, RobotwinSimulator)
    try:
        scenario = make(simulator, recipe)
    except (ScenarioError, SimulatorError, RuntimeError) as err:
        atomic_write(refused, str(err))
        return str(err)
    write_scenarios(kept, [scenario], description=_DESCRIPTION, license="Apache-2.0")
    return scenario


def main(argv: list[str] | None = None) -> int:
    """Runs the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m recipes.robotwin.starter")
    parser.add_argument("--out", type=Path, required=True, help="dataset folder to write")
    parser.add_argument(
        "--work",
        type=Path,
        default=None,
        help="folder that keeps each recipe's scenario, or why there is none, so that an interrupted run "
        "goes on where it was; default: <out>.work",
    )
    parser.add_argument("--only", default="", help="make only the recipes whose id contains this")
    parser.add_argument("--robotwin-root", default=None, help="RoboTwin checkout; default $ROBOTWIN_ROOT")
    parser.add_argument("--jobs", type=int, default=2, help="simulators at work at once")
    args = parser.parse_args(argv)
    work = args.work or args.out.with_name(f"{args.out.name}.work")
    scenarios, problems = [], 0
    recipes = [recipe for recipe in RECIPES if args.only in recipe.id]
    options = {"robotwin_root": args.robotwin_root, "obs_type": "state"}
    with JobPool("robotwin", options, args.jobs) as pool:
        made = pool.map_ordered(_attempt, recipes, lambda recipe: (work, recipe))
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
