"""CPU milliseconds of one picture, as LeRobot renders it and as a person who drives sees it.

python benchmarks/live_pictures.py [--size 256] [--pictures 16]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.studio.teleop.starts import first_state

TASKS = {"libero": ("open_the_middle_drawer_of_the_cabinet", "libero_goal"), "metaworld": ("push-v3", "")}


def cost_ms(platform: str, quality: str, size: int, pictures: int) -> float:
    """CPU milliseconds of one camera's picture, a step between any two left out."""
    simulator = make_simulator(
        platform, observation_height=size, observation_width=size, obs_type="pixels", render_quality=quality
    )
    start = first_state(platform, *TASKS[platform])
    simulator.reset(start.task, start.reset)
    simulator.observe()  # makes the context
    spent, made = 0.0, 0
    while made < pictures:
        simulator.step(np.zeros(simulator.action_dim))
        began = time.process_time()
        pixels = simulator.observe()["pixels"]
        spent += time.process_time() - began
        made += len(pixels) if isinstance(pixels, dict) else 1
    simulator.close()
    return 1000 * spent / made


def main() -> None:
    """Prints a line for each platform and quality."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--pictures", type=int, default=16)
    args = parser.parse_args()
    for platform in TASKS:
        for quality in ("full", "fast"):
            print(f"{platform} {quality}: {cost_ms(platform, quality, args.size, args.pictures):.0f} ms")


if __name__ == "__main__":
    main()
