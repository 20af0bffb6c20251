"""Pictures of candidate recovery points, and what looking at them decided."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.platforms.metaworld import PLATFORM
from lerobot_roborecover.platforms.metaworld.simulator import MetaworldSimulator
from lerobot_roborecover.platforms.simulator import iter_steps
from lerobot_roborecover.scenario import Reset, Rollout

_HELD = "the picture shows the object between the fingers"
DROPPED: dict[str, str] = {
    "assembly-v3-natural-act_metaworld_weak-8": "the same picture as seed 7",
    "assembly-v3-natural-act_metaworld_weak-26": "the fingers are at the nut: not Approach",
    "basketball-v3-natural-act_metaworld_weak-3": "the ball is held over the basket: not Move",
    "basketball-v3-perturbed-expert_biased-2": _HELD,
    "coffee-push-v3-natural-act_metaworld_weak-3": _HELD,
    "coffee-push-v3-natural-act_metaworld_weak-11": _HELD,
    "coffee-push-v3-natural-act_metaworld_weak-14": _HELD,
    "coffee-push-v3-perturbed-expert_biased-9": "the fingers are at the mug: not Approach",
    "shelf-place-v3-natural-act_metaworld_weak-10": "the cube lies on the shelf's edge: rather Place",
    "shelf-place-v3-perturbed-expert_biased-1": _HELD,
    "shelf-place-v3-perturbed-expert_biased-10": _HELD,
}
"""Proven candidates by key whose picture does not settle the label, and why."""

SHEET_STEPS = (-40, -15, 0, 15, 60)
"""Frames of a sheet, in steps from the recovery point; the later ones show how the source rollout went on."""


def draw_sheets(out: Path, rows: list[dict[str, Any]], size: int = 240) -> None:
    """Writes `sheets/<key>.png` for each row: the frames of `SHEET_STEPS`, side by side.

    Args:
        out: working folder of the starter set.
        rows: selected rows.
        size: side of a frame, pixels.
    """
    from PIL import Image

    folder = out / "sheets"
    folder.mkdir(exist_ok=True)
    simulator = MetaworldSimulator(size, size)
    for row in rows:
        path = folder / f"{row['key']}.png"
        if path.exists():
            continue
        actions = np.load(out / "actions" / f"{row['key']}.npy")
        wanted = {min(max(row["step"] + s, 0), len(actions)) for s in SHEET_STEPS}
        rollout = Rollout(PLATFORM.task(row["task"]), Reset(seed=row["seed"]), actions)
        frames = [simulator.render() for step in iter_steps(simulator, rollout) if step in wanted]
        Image.fromarray(np.concatenate(frames, axis=1)).save(path)
    simulator.close()
