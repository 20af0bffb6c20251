"""What the generic platform costs: steps of a LeRobot env type through it, against the bare environment's.

    python benchmarks/lerobot_env_overhead.py
    python benchmarks/lerobot_env_overhead.py --platform lerobot_aloha --steps 50 --rounds 10

Both step the same environment class with the same actions from the same seed, in short turns one after the
other, so that the machine's moods fall on both; printed is the median of the turns' ratios. The bare
environment of Aloha draws three pictures a step, which the platform skips where no image is requested: there
the ratio shows the cost of a replay.
"""

from __future__ import annotations

import argparse
import statistics
import time

import gymnasium as gym
import numpy as np

from lerobot_roborecover.platforms import make_simulator, platform_named
from lerobot_roborecover.platforms.lerobot.known import KNOWN
from lerobot_roborecover.scenario import Reset


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--platform", default="lerobot_pusht")
    parser.add_argument("--steps", type=int, default=200, help="of a turn")
    parser.add_argument("--rounds", type=int, default=40, help="turns of each")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    platform = platform_named(args.platform)
    facts = KNOWN[platform.env_defaults["base"]["type"]]
    (task, *_) = platform.tasks()
    simulator = make_simulator(args.platform, obs_type="state")
    bare = gym.make(f"{facts.package}/{task.name}", **facts.kwargs, max_episode_steps=-1)
    actions = simulator.random_actions(np.random.default_rng(args.seed), args.steps)  # ty: ignore
    ratios, speeds = [], []
    for turn in range(args.rounds):
        simulator.reset(task, Reset(seed=turn))
        bare.reset(seed=turn)
        taken = {}
        for step in (simulator.step, bare.step) if turn % 2 else (bare.step, simulator.step):
            began = time.perf_counter()
            for action in actions:
                step(action)
            taken[step == bare.step] = time.perf_counter() - began
        ratios.append(taken[False] / taken[True])
        speeds.append(args.steps / taken[True])
    low, high = np.percentile(ratios, [25, 75])
    print(
        f"{args.platform}: {statistics.median(ratios):.3f} times a bare step (quartiles {low:.3f} to "
        f"{high:.3f}, {args.rounds} turns of {args.steps}); bare: {statistics.median(speeds):.0f} steps/s"
    )


if __name__ == "__main__":
    main()
