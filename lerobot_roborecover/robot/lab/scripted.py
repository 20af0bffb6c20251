"""Checkpoints of the lab's scripted policy: `python -m lerobot_roborecover.robot.lab.scripted FOLDER`."""

from __future__ import annotations

import argparse
from pathlib import Path

from lerobot_roborecover.scenario import ScenarioError


def save_scripted(folder: Path, size: int = 96, bias_mm: float = 0.0, goal_x_mm: float = -300.0) -> Path:
    """Writes a checkpoint.

    Args:
        folder: new or empty.
        size: rows and columns of the lab's pictures.
        bias_mm: see `LabPusherConfig`.
        goal_x_mm: see `LabPusherConfig`.

    Raises:
        ScenarioError: the folder is not empty.
    """
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_roborecover.robot.lab.configuration_lab_pusher import LabPusherConfig
    from lerobot_roborecover.robot.lab.modeling_lab_pusher import LabPusherPolicy
    from lerobot_roborecover.robot.lab.processor_lab_pusher import make_lab_pusher_pre_post_processors

    if folder.exists() and any(folder.iterdir()):
        raise ScenarioError(f"{folder} is not an empty folder; name a new one")
    config = LabPusherConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
            "observation.images.top": PolicyFeature(FeatureType.VISUAL, (3, size, size)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        bias_mm=bias_mm,
        goal_x_mm=goal_x_mm,
        device="cpu",
    )
    LabPusherPolicy(config).save_pretrained(folder)
    for part in make_lab_pusher_pre_post_processors(config):
        part.save_pretrained(folder)
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description="Write a checkpoint of the simulated lab's scripted policy.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=int, default=96, help="of the lab's pictures (96)")
    parser.add_argument("--bias-mm", type=float, default=0.0, help="error of its eye: a worse policy (0)")
    args = parser.parse_args()
    print(save_scripted(args.folder, args.size, args.bias_mm))


if __name__ == "__main__":
    main()
