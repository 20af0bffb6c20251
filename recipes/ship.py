"""Copies a trained policy as it ships: half precision, for a CPU, without the training's settings and places.

    python -m recipes.ship CHECKPOINT policies/pusht/NAME
    python -m recipes.ship CHECKPOINT policies/libero/tdmpc_recover --only model._encoder model._pi

LeRobot loads them into float32 again.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from pathlib import Path


def ship(checkpoint: Path, out: Path, only: Sequence[str] = ()) -> None:
    """Copies a trained policy in half precision, for a CPU, without the training's settings and places.

    LeRobot loads the weights into float32 again, and infers in it: mixed precision, with which a policy may
    have been trained, gives bfloat16 on a CPU, which `lerobot-eval` cannot hand to a simulator.

    Args:
        checkpoint: a `pretrained_model` folder.
        out: folder to write.
        only: beginnings of the names of the weights that acting needs; none keeps all. LeRobot says at every
            load which are missing.

    Raises:
        ValueError: a beginning fits no weight.
    """
    import torch
    from safetensors.torch import load_file, save_file

    out.mkdir(parents=True, exist_ok=True)
    for file in sorted(checkpoint.iterdir()):
        if file.name == "model.safetensors":
            weights = load_file(file)
            for prefix in only:
                if not any(name.startswith(prefix) for name in weights):
                    known = sorted({name.rsplit(".", 2)[0] for name in weights})
                    raise ValueError(f"no weight's name begins with {prefix}; there are {', '.join(known)}")
            weights = {k: v for k, v in weights.items() if not only or k.startswith(tuple(only))}
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
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="PREFIX",
        help="beginnings of the names of the weights to keep, where acting does not need all",
    )  # fmt: skip
    args = parser.parse_args()
    ship(args.checkpoint, args.out, args.only)


if __name__ == "__main__":
    main()
