"""Gives a dataset the normalisation statistics of a checkpoint that is trained further on it.

`lerobot-train` replaces a checkpoint's statistics by the dataset's. Donors are few, and of few tasks: their
own statistics would shift and blow up what the checkpoint's weights have learned to read.
"""

from __future__ import annotations

import json
from pathlib import Path

from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write

_STATS = Path("meta") / "stats.json"
_PREPROCESSOR = "policy_preprocessor.json"


def use_statistics_of(root: Path, folder: Path) -> list[str]:
    """Replaces statistics of observations and actions in `meta/stats.json`.

    Args:
        root: a LeRobotDataset's folder.
        folder: a checkpoint's.

    Returns:
        Names of the features whose statistics were replaced.

    Raises:
        ScenarioError: the checkpoint has none, or is of other features.
    """
    from safetensors.numpy import load_file

    try:
        steps = json.loads((folder / _PREPROCESSOR).read_text())["steps"]
        files = [s["state_file"] for s in steps if s.get("registry_name") == "normalizer_processor"]
        saved = load_file(folder / Path(files[0]).name)
    except (OSError, ValueError, KeyError, IndexError, TypeError) as err:
        raise ScenarioError(
            f"{folder} has no normalisation statistics in {_PREPROCESSOR} ({err!r:.200})"
        ) from None
    path = root / _STATS
    stats = json.loads(path.read_text())
    replaced = set()
    for key, value in saved.items():
        feature, _, name = key.rpartition(".")
        if feature not in stats or not (feature == "action" or feature.startswith("observation.")):
            continue
        width = len(stats[feature]["mean"])
        if name != "count" and len(value) != width:
            raise ScenarioError(
                f"{folder} was trained on {feature} of width {len(value)}; {root} has {width}. They are of "
                "different observation or action spaces"
            )
        stats[feature][name] = value.tolist()
        replaced.add(feature)
    if "action" not in replaced:
        raise ScenarioError(
            f"{folder} has no statistics of the action; it cannot be trained further on {root}"
        )
    atomic_write(path, json.dumps(stats, indent=4) + "\n")
    return sorted(replaced)
