"""One policy's training by `lerobot-train`, which goes on where it was interrupted."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.atomic_io import atomic_dir
from recipes.commands import program


@dataclass(frozen=True)
class Training:
    """What `lerobot-train` is asked for."""

    config: Path
    """A training configuration."""
    dataset: Path
    """Folder of a LeRobotDataset."""
    folder: Path
    """Of the training's own files."""
    episodes: list[int] | None = None
    """Of the dataset; None: all."""
    device: str = "cpu"
    options: tuple[str, ...] = ()
    """More of `lerobot-train`, e.g. `--seed=1`."""

    def arguments(self) -> list[str]:
        """Of `lerobot-train`: from the start, or from the last checkpoint."""
        last = self.folder / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
        if last.exists():
            return [f"--config_path={last}", "--resume=true"]
        wanted = self.episodes
        return [
            f"--config_path={self.config}",
            f"--dataset.root={self.dataset}",
            f"--output_dir={self.folder}",
            *([] if self.device == "cpu" else [f"--policy.device={self.device}"]),
            *([] if wanted is None else [f"--dataset.episodes={json.dumps(wanted, separators=(',', ':'))}"]),
            *self.options,
        ]

    def train(self) -> Path:
        """Trains, from memory.

        Returns:
            The last checkpoint.

        Raises:
            subprocess.CalledProcessError: the training failed; its own output says why.
        """
        arguments = self.arguments()
        if "--resume=true" not in arguments:  # LeRobot refuses the folder of a run without a checkpoint
            shutil.rmtree(self.folder, ignore_errors=True)
        program("recipes.frames_in_memory", *arguments)
        return self.folder / "checkpoints" / "last"

    def run(self, result: Path) -> None:
        """Trains, and puts the policy into `result`.

        Raises:
            subprocess.CalledProcessError: as `train`.
        """
        last = self.train()
        with atomic_dir(result) as policy:
            shutil.copytree(
                last / "pretrained_model",
                policy,
                ignore=shutil.ignore_patterns("train_config.json"),
            )
