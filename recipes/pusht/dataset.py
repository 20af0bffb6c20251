"""Demonstrations of PushT by the scripted controller as a LeRobotDataset without images, for `lerobot-train`.

In a third of the episodes the executed target is disturbed during the first steps, while the recorded action
stays the driver's, so that a policy trained on them has seen states beside its path.

    python -m recipes.pusht.dataset --out DIR --episodes 400
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.curation.rollout import perturb_translations
from lerobot_roborecover.datasets.lerobot_folder import local_repo_id
from lerobot_roborecover.platforms import make_simulator, platform_named
from lerobot_roborecover.scenario import Reset

FIRST_SEED = 100_000
"""Seeds of demonstrations start here, as in PushT's published recipe those of its evaluation; scenarios use
smaller ones."""
_STEPS_AFTER_SUCCESS = 3
_PERTURBED_STEPS = 60
_PERTURBATION = (25.0, 25.0)
"""Half-widths of the disturbance, pixels."""

type Episode = list[dict[str, np.ndarray]]


def demonstration(simulator: Any, seed: int, perturbed: bool) -> Episode | None:
    """One episode up to a few solved steps; None where the controller did not solve it.

    Args:
        simulator: of `lerobot_pusht`.
        seed: of the reset and of the disturbance.
        perturbed: disturb the first steps.
    """
    platform = platform_named("lerobot_pusht")
    task, rng, frames, solved = platform.tasks()[0], np.random.default_rng(seed), [], 0
    simulator.reset(task, Reset(seed=seed))
    act = platform.experts["expert"].make(simulator, task, rng)
    for t in range(task.horizon):
        action, seen = act(t), simulator.observe()
        executed = (
            perturb_translations(action, rng, _PERTURBATION) if perturbed and t < _PERTURBED_STEPS else action
        )
        simulator.step(executed)
        solved += simulator.succeeded()
        frames.append(
            {
                "observation.state": seen["agent_pos"],
                "observation.environment_state": seen["environment_state"],
                "action": action,
                "next.reward": np.array([float(simulator.succeeded())]),
            }
        )
        if solved == _STEPS_AFTER_SUCCESS:
            return frames
    return None


def write_demonstrations(root: Path, count: int) -> None:
    """Writes the dataset; `root` must not exist. Features are those of `--env.obs_type=state`, float32."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    widths = {"observation.state": 2, "observation.environment_state": 16, "action": 2, "next.reward": 1}
    dataset = LeRobotDataset.create(
        repo_id=local_repo_id(root),
        root=root,
        fps=10,
        robot_type="pusht",
        features={name: {"dtype": "float32", "shape": (n,), "names": None} for name, n in widths.items()},
        use_videos=False,
    )
    simulator = make_simulator("lerobot_pusht", obs_type="state")
    instruction = platform_named("lerobot_pusht").tasks()[0].instruction
    seed, found = FIRST_SEED, 0
    while found < count:
        episode = demonstration(simulator, seed, perturbed=seed % 3 == 0)
        seed += 1
        if episode is None:
            continue
        for frame in episode:
            dataset.add_frame({k: v.astype(np.float32) for k, v in frame.items()} | {"task": instruction})
        dataset.save_episode()
        found += 1
        if found % 20 == 0:
            print(f"{found} episodes from {seed - FIRST_SEED} rollouts", flush=True)
    dataset.finalize()
    simulator.close()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write; must not exist")
    parser.add_argument("--episodes", type=int, default=400)
    args = parser.parse_args()
    write_demonstrations(args.out, args.episodes)


if __name__ == "__main__":
    main()
