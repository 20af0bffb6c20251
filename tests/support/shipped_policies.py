"""A checkpoint for command lines that are refused for another reason."""

from __future__ import annotations

from pathlib import Path

CHECKPOINT = str(Path(__file__).parents[2] / "policies" / "libero" / "act_few")
