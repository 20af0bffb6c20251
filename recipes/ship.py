"""Copies a trained policy as it ships: half precision, for a CPU, without the training's settings and places.

    python -m recipes.ship CHECKPOINT policies/pusht/NAME

LeRobot loads them into float32 again.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path


def ship(checkpoint: Path, out: Path) -> None:
    """Copies a trained policy in half precision, for a CPU, without the training's settings and places.

    LeRobot loads the weights into float32 again, and infers in it: mixed precision, with which a policy may
    have been trained, gives bfloat16 on a CPU, which `lerobot-eval` cannot hand to a simulator.

    Args:
        checkpoint: a `pretrained_model` folder.
        out: folder to write.
    """
    import torch
    from safetensors.torch import load_file, save_file

    out.mkdir(parents=True, exist_ok=True)
    for file in sorted(checkpoint.iterdir()):
        if file.name == "model.safetensors":
            weights = load_file(file)
            half = {k: v.half() if v.dtype == torch.float32 else v for k, v in weights.items()}
            save_file(half, out / file.name, metadata={"format": "pt"})
        elif file.name == "config.json":
            # Which folder training went on from is a place of the machine that trained.
            config = json.loads(file.read_text()) | {
                "device": "cpu",
                "pretrained_path": None,
                "use_amp": False,
            }
            (out / file.name).write_text(json.dumps(config, indent=4))
        elif file.suffix == ".json" and file.name != "train_config.json":
            (out / file.name).write_text(file.read_text().replace('"device": "cuda"', '"device": "cpu"'))
        elif file.name != "train_config.json":
            shutil.copyfile(file, out / file.name)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    ship(args.checkpoint, args.out)


if __name__ == "__main__":
    main()
