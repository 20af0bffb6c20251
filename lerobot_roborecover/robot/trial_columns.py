"""What a run's dataset says of each frame's trial: policy, recovery point, start error, verdict.

A verdict is given after its episode was saved, may be taken back, and may come after a crash. So the recorder
writes what is known when a trial begins, and the verdict follows from the run's journal later.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from lerobot_roborecover.logs.robot import StartError
from lerobot_roborecover.utils.atomic_io import atomic_file

_MEASURES = ("joint", "background_px", "object_px")
_NO_VERDICT = {"verdict": "", "reason": "", "rater": ""}

COLUMNS: dict[str, dict[str, Any]] = {
    **{name: {"dtype": "string", "shape": (1,), "names": None} for name in ("policy", "recovery_point")},
    **{f"start_error.{m}": {"dtype": "float32", "shape": (1,), "names": None} for m in _MEASURES},
    **{name: {"dtype": "string", "shape": (1,), "names": None} for name in _NO_VERDICT},
}
"""LeRobot's features by name. An empty verdict: none counts. NaN: not measured."""


def trial_values(policy: str, point: str, error: StartError | None) -> dict[str, Any]:
    """Values of all columns when a trial begins.

    Args:
        policy: its name in the plan.
        point: id of the recovery point.
        error: as measured last.
    """
    worst = {m: None if error is None else error.worst(m) for m in _MEASURES}
    numbers = {f"start_error.{m}": math.nan if v is None else float(v) for m, v in worst.items()}
    return {"policy": policy, "recovery_point": point, **numbers, **_NO_VERDICT}


def verdicts_of(
    records: Iterable[Mapping[str, Any]], rows: Mapping[int, Mapping[str, Any]]
) -> dict[int, dict[str, Any]]:
    """Verdict columns by episode.

    Args:
        records: of the run's journal.
        rows: of the trial log that count, by the trial's place.
    """
    rolled = (r["episode"] for r in records if r["kind"] == "rollout")
    found = {episode: dict(_NO_VERDICT) for episode in rolled if episode is not None}
    for row in rows.values():
        robot = row["robot"]
        if robot["episode"] is not None:
            values = {"verdict": robot["verdict"], "reason": row["reason"], "rater": robot["rater"]}
            found[robot["episode"]] = values
    return found


def write_columns(root: Path, wanted: Mapping[int, Mapping[str, Any]]) -> None:
    """Sets columns of saved episodes, where they differ; columns that the dataset lacks are left out.

    Args:
        root: folder of the dataset.
        wanted: values of columns by episode.
    """
    if not wanted or not root.is_dir():
        return
    import pyarrow as pa
    import pyarrow.parquet as pq

    for path in sorted(root.glob("data/*/*.parquet")):
        try:
            schema = pq.read_schema(path)
        except pa.ArrowInvalid:
            continue  # a crash cut it off; the next episode takes its place
        names = [n for n in COLUMNS if n in schema.names]
        table = pq.read_table(path, columns=["episode_index", *names])
        episodes = table["episode_index"].to_pylist()
        changed = {}
        for name in names:
            before = table[name].to_pylist()
            after = [wanted.get(e, {}).get(name, v) for e, v in zip(episodes, before, strict=True)]
            if after != before:
                changed[name] = pa.array(after, schema.field(name).type)
        if not changed:
            continue
        whole = pq.read_table(path)
        for name, values in changed.items():
            whole = whole.set_column(schema.get_field_index(name), schema.field(name), values)
        with atomic_file(path) as temporary:
            pq.write_table(whole, temporary, compression="snappy", use_dictionary=True)
