"""Run by the doctor in a process of its own: LeRobot's plugin discovery, GPUs, torchcodec and OpenCV."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from typing import Any

from lerobot_roborecover.platforms.probe import answer


def _discovered() -> bool:
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    return "lerobot_env_roborecover" in sys.modules


def _env_types() -> list[str]:
    # Discovery logs a plugin's import error and goes on; importing it here shows the error itself.
    importlib.import_module("lerobot_env_roborecover")
    from lerobot.envs.configs import EnvConfig

    return sorted(name for name in EnvConfig.get_known_choices() if name.startswith("roborecover_"))


def _cuda() -> dict[str, Any]:
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    return {"torch": torch.__version__, "devices": [torch.cuda.get_device_name(i) for i in range(count)]}


def _version(module: str) -> str:
    return getattr(importlib.import_module(module), "__version__", "of unknown version")


QUESTIONS: dict[str, Callable[[], Any]] = {
    "discovered": _discovered,
    "env_types": _env_types,
    "cuda": _cuda,
    "torchcodec": lambda: _version("torchcodec"),
    "cv2": lambda: _version("cv2"),
}


def main() -> None:
    """Answers every question, or says why not."""
    answers: dict[str, Any] = {}
    for name, question in QUESTIONS.items():
        try:
            answers[name] = question()
        except (
            Exception
        ) as err:  # a library that fails to load raises whatever it likes; the report carries it
            answers[name] = {"error": f"{type(err).__name__}: {' '.join(str(err).split())}"[:400]}
    answer(answers)


if __name__ == "__main__":
    main()
