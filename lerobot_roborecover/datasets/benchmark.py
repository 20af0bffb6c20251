"""A published scenario set as the Hub knows benchmarks and shows tables.

`eval.yaml` at the root says what is measured (https://huggingface.co/docs/hub/eval-results). The dataset
viewer and `datasets.load_dataset` read one file a split below `viewer/`: `scenarios.parquet` holds all splits
in one, for evaluation, and no pictures that a viewer would know as such.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_roborecover.scenario import Scenario

EVAL_FILE = "eval.yaml"
VIEWER_FOLDER = "viewer"
CONFIG = "scenarios"
"""The viewer's name of the tables below `viewer/`."""
FRAMEWORK = "roborecover"
TASKS = {
    "recovery_success_rate": "recovery success rate (RSR), per cent: from recovery points, every scenario "
    "weighing the same",
    "macro_recovery_success_rate": "mean over the cells of stage and deviation type that are large enough, "
    "per cent",
    "initial_state_success_rate": "the same tasks from their initial states, per cent",
}
"""Ids of the results that a model's `.eval_results/` gives, and what each is."""
_FRAME_PX = 256
_MADE = "# Made by roborecover:card; take this line away to keep the file as it is."


def split_names(scenarios: Sequence[Scenario]) -> dict[str, str]:
    """The Hub's name of every split, which may hold letters, digits, dots and underscores."""
    names: dict[str, str] = {}
    for split in sorted({s.split for s in scenarios}):
        name = re.sub(r"\W+", "_", split)
        while name in names.values():
            name += "_"
        names[split] = name
    return names


def viewer_file(split: str) -> str:
    """Path of a split's table in the repository.

    Args:
        split: by the Hub's name.
    """
    return f"{VIEWER_FOLDER}/{split}.parquet"


def viewer_config(splits: Mapping[str, str]) -> dict[str, Any]:
    """The card's entry of `configs` that shows scenarios first."""
    files = [{"split": name, "path": viewer_file(name)} for name in splits.values()]
    return {"config_name": CONFIG, "data_files": files, "default": True}


def main_split(splits: Mapping[str, str]) -> str:
    """The split that results are of: `test`, or the first where there is none."""
    return splits.get("test", next(iter(splits.values())))


def eval_yaml(title: str, platform: str, count: int, splits: Mapping[str, str]) -> bytes:
    """The benchmark's `eval.yaml`.

    Args:
        title: of the set.
        platform: its simulator.
        count: of scenarios.
        splits: of `split_names`.
    """
    import yaml

    measured = "; ".join(f"{task}: {about}" for task, about in TASKS.items())
    about = {
        "name": title,
        "description": f"Do robot policies recover once their own execution has gone wrong? {count} recovery "
        f"points on {platform}, each an exact replay of recorded actions, from which the policy continues "
        f"the task. Results: {measured}.",
        "evaluation_framework": FRAMEWORK,
        "tasks": [{"id": task, "config": CONFIG, "split": main_split(splits)} for task in TASKS],
    }
    return f"{_MADE}\n{yaml.safe_dump(about, sort_keys=False, allow_unicode=True, width=100)}".encode()


def viewer_tables(
    scenarios: Sequence[Scenario], frame_of: Callable[[int], np.ndarray | None], splits: Mapping[str, str]
) -> dict[str, bytes]:
    """Parquet files of the viewer, by path in the repository.

    Args:
        scenarios: of the dataset, in its order.
        frame_of: (H, W, 3) uint8, the recovery frame of the scenario in a row; None where there is none.
        splits: of `split_names`.
    """
    rows = [_row(scenario, frame_of(row)) for row, scenario in enumerate(scenarios)]
    pictures = any(row["recovery_frame"] for row in rows)
    split_of = [s.split for s in scenarios]
    return {
        viewer_file(name): _parquet([r for r, s in zip(rows, split_of, strict=True) if s == split], pictures)
        for split, name in splits.items()
    }


def _row(scenario: Scenario, frame: np.ndarray | None) -> dict[str, Any]:
    return {
        "id": scenario.id,
        "recovery_frame": None if frame is None else {"bytes": _jpeg(frame), "path": f"{scenario.id}.jpg"},
        "instruction": scenario.task.instruction,
        "suite": scenario.task.suite,
        "task": scenario.task.name,
        "stage": scenario.stage.value,
        "deviation_type": scenario.deviation.value,
        "source": scenario.source.value,
        "source_policy": scenario.source_policy,
        "prefix_steps": len(scenario.prefix),
        "horizon": scenario.task.horizon,
        "cluster": scenario.cluster,
        "sha256": scenario.sha256(),
    }


def _parquet(rows: Sequence[Mapping[str, Any]], pictures: bool) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    types = {name: pa.int64() if isinstance(value, int) else pa.string() for name, value in rows[0].items()}
    types["recovery_frame"] = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    if not pictures:
        del types["recovery_frame"]
    # What makes the viewer and `datasets` show a picture in place of its bytes.
    features = {
        name: {"_type": "Image"} if name == "recovery_frame" else {"dtype": str(kind), "_type": "Value"}
        for name, kind in types.items()
    }
    schema = pa.schema(list(types.items()), {"huggingface": json.dumps({"info": {"features": features}})})
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(list(rows), schema), buffer, row_group_size=100)
    return buffer.getvalue()


def _jpeg(frame: np.ndarray) -> bytes:
    from PIL import Image

    image = Image.fromarray(frame)
    image.thumbnail((_FRAME_PX, _FRAME_PX))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=88)
    return buffer.getvalue()
