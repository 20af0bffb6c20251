"""Configuration files of builds on the fake platform."""

from __future__ import annotations

import json
from pathlib import Path

import yaml

FAKE = {
    "platform": "fake",
    "collect": {
        "biased": {"expert": "expert_biased", "task": ["push-*"], "draw": 4, "frames": 32, "num_workers": 1},
        "shaken": {
            "expert": "expert_biased", "task": ["push-left"], "draw": 2, "perturb": True, "frames": 32,
            "num_workers": 1,
        },
    },
    "screen": {"trials": 2, "keep": [0, 99], "num_workers": 1},
    "validate": {"runs": 2, "num_workers": 2},
    "split": {"sizes": {"train": 0.5, "test": 0.5}},
    "render": {"frames": 64},
}  # fmt: skip


def write(path: Path, content: dict) -> Path:
    path.write_text(yaml.safe_dump(content))
    return path


def changed(content: dict, key: str, value) -> dict:
    """A copy with one entry, `a.b.c`, set or, with None, taken out."""
    content = json.loads(json.dumps(content))
    *path, last = key.split(".")
    node = content
    for part in path:
        node = node.setdefault(part, {})
    node.pop(last, None) if value is None else node.update({last: value})
    return content


WHOLE = {**FAKE, "out": "x", "screen": {**FAKE["screen"], "policies": [{"path": "p"}]}}
