"""How alike a lossy original and its exact replay are: rendered again, and encoded likewise.

    python benchmarks/video_ssim.py --task assembly-v3 --size 480 --steps 120 --step 100

Records one rollout of a Meta-World expert, encodes it as `curate collect` does (LeRobot's default), and
compares the decoded last five frames up to `--step` with the very frames that were encoded: as they are,
through the same encoder with the window that `curate validate` takes, and with the frames after the
recovery point left out. Everything is of the same state: what is below 1 is the video's doing.
"""

from __future__ import annotations

import argparse

import numpy as np

from lerobot_roborecover.curation.validate.frames import TAIL, Encoder, encoded, ssim, window
from lerobot_roborecover.datasets.frames import KEPT
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.platforms.metaworld import PLATFORM
from lerobot_roborecover.platforms.metaworld.experts import expert
from lerobot_roborecover.scenario import Reset


def rollout(task_name: str, size: int, steps: int) -> list[np.ndarray]:
    """(H, W, 3) frames of one rollout, one a step."""
    simulator = make_simulator("metaworld", observation_height=size, observation_width=size)
    simulator.reset(PLATFORM.task(task_name), Reset(seed=0))
    act = expert(simulator, task_name)
    frames = []
    for t in range(steps):
        frames.append(np.asarray(simulator.render()))
        simulator.step(act(t))
    simulator.close()
    return frames


def lerobots_encoder(fps: int) -> Encoder:
    """LeRobot's default settings."""
    from lerobot.configs.video import RGBEncoderConfig

    config = RGBEncoderConfig()
    options = {k: str(v) for k, v in config.get_codec_options(as_strings=True).items()}
    return Encoder(config.vcodec, config.pix_fmt, options, fps, int(config.g or 1))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="assembly-v3")
    parser.add_argument("--size", type=int, default=480)
    parser.add_argument("--steps", type=int, default=120, help="of the rollout")
    parser.add_argument("--step", type=int, default=100, help="the recovery point")
    args = parser.parse_args()
    frames = rollout(args.task, args.size, args.steps)
    encoder = lerobots_encoder(80)
    wanted = range(args.step - KEPT + 1, args.step + 1)
    original = np.stack([encoded(frames, encoder)[i] for i in wanted])
    clip = window(args.step, len(frames), encoder)
    short = range(clip.start, args.step + 1)
    rows = {"rendered again": np.stack([frames[i] for i in wanted])}
    for name, part in ((f"through the encoder, {TAIL} frames beyond", clip), ("none beyond", short)):
        seen = encoded([frames[i] for i in part], encoder)
        rows[name] = np.stack([seen[i - part.start] for i in wanted])
    print(f"{args.task}, {args.size} x {args.size}, {encoder}: mean SSIM of {KEPT} frames")
    for name, replay in rows.items():
        print(f"  {name:<42} {np.mean(ssim(original, replay)):.3f}")


if __name__ == "__main__":
    main()
