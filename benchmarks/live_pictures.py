"""CPU milliseconds of one camera's picture, `full` as LeRobot renders it and `fast`, in one run.

python benchmarks/live_pictures.py [--sizes 64 128 256] [--pictures 16] [--platforms libero metaworld]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.web.teleop.starts import first_state

TASKS = {
    "libero": [
        ("pick_up_the_black_bowl_next_to_the_plate_and_place_it_on_the_plate", "libero_spatial"),
        ("pick_up_the_cream_cheese_and_place_it_in_the_basket", "libero_object"),
        ("open_the_middle_drawer_of_the_cabinet", "libero_goal"),
        ("KITCHEN_SCENE3_turn_on_the_stove_and_put_the_moka_pot_on_it", "libero_10"),
        ("STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_back_compartment_of_the_caddy", "libero_10"),
    ],
    "metaworld": [("push-v3", "")],
}
CAMERAS = {"libero": ("agentview_image", "robot0_eye_in_hand_image"), "metaworld": ("corner2",)}


def cost_ms(
    platform: str, task: tuple[str, str], camera: str, quality: str, size: int, pictures: int
) -> tuple[float, float]:
    """CPU milliseconds of a picture, steps left out, and seconds until the first one of a compiled task."""
    simulator = make_simulator(
        platform,
        observation_height=size,
        observation_width=size,
        obs_type="pixels",
        render_quality=quality,
        camera_name=camera,
    )
    start = first_state(platform, *task)
    simulator.reset(start.task, start.reset)
    began = time.perf_counter()
    simulator.observe()  # makes the context
    load_s, spent_s = time.perf_counter() - began, 0.0
    for _ in range(pictures):
        simulator.step(np.zeros(simulator.action_dim))
        began = time.process_time()
        simulator.observe()
        spent_s += time.process_time() - began
    simulator.close()
    return 1000 * spent_s / pictures, load_s


def main() -> None:
    """Prints a table row for each platform, camera, size and task."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256])
    parser.add_argument("--pictures", type=int, default=16)
    parser.add_argument("--platforms", nargs="+", choices=TASKS, default=list(TASKS))
    args = parser.parse_args()
    print("| camera | size | scene | full, ms | fast, ms | ratio | first, s |\n|---|---|---|---|---|---|---|")
    for platform in args.platforms:
        for camera in CAMERAS[platform]:
            for size in args.sizes:
                for task in TASKS[platform]:
                    full, _ = cost_ms(platform, task, camera, "full", size, args.pictures)
                    fast, load_s = cost_ms(platform, task, camera, "fast", size, args.pictures)
                    scene = f"{task[1] or platform} {task[0][:12]}"
                    cells = f"{full:.0f} | {fast:.1f} | {full / fast:.0f} | {load_s:.2f}"
                    print(f"| {camera} | {size} | {scene} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
