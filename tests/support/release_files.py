"""A synthetic release in the paper's own format, for tests and benchmarks; none of the paper's data."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import numpy as np

STAGES = ("Approach", "Contact", "Move", "Place")
TYPES = ("Wrong Target", "Wrong Pose", "Stage Rollback", "Scene Change")
COLUMNS = (
    "sample_id", "path", "sha256", "original_sha256", "actions", "replay_prefix_steps", "task_name",
    "s_stage", "d_stage",
)  # fmt: skip
NO_OP = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]


def libero_record(index: int, steps: int = 20, extra_action: bool = True) -> dict:
    """A LIBERO record of `steps` actions after ten settling no-ops."""
    rng = np.random.default_rng(index)
    drive = rng.uniform(-1.5, 1.5, (steps, 7))
    drive[:, 6] = np.sign(drive[:, 6])
    actions = [list(NO_OP)] * 10 + drive.tolist()
    return {
        "task_description": "put the bowl on the plate",
        "task_id": index % 10,
        "episode_idx": index % 50,
        "seed": 7,
        "task_suite_name": ("libero_spatial", "libero_10")[index % 2],
        "data_type": "OOD_data",
        "model_name": ("pi05_disturb", "being_h05", "human_teleop")[index % 3],
        "error_category": f"S:{STAGES[index % 4]};D:{TYPES[index % 4]}",
        "target_error_category": f"S:{STAGES[index % 4]};D:{TYPES[index % 4]}",
        "s_stage": STAGES[index % 4],
        "d_stage": TYPES[index % 4],
        "annotated_step": len(actions) - extra_action,
        "initial_state": {
            "gripper": 0.04,
            "quat": [1.0, 0.0, 0.0, 0.0],
            "rpy": [3.14, 0.0, 0.0],
            "xyz": rng.uniform(-0.1, 0.1, 3).tolist(),
        },
        "actions": actions,
    }


def robotwin_record(index: int, steps: int = 20, ee: bool = False) -> dict:
    """A RoboTwin record; joint or end-effector actions."""
    rng = np.random.default_rng(index)
    record = {
        "task_suite_name": "robotwin",
        "task_name": ("stack_blocks_two", "open_microwave")[index % 2],
        "task_config": "demo_clean",
        "task_description": "stack the blocks",
        "episode_idx": index,
        "seed": 100000 + index,
        "instruction": "Put the red block on the gréen one.",
        "instruction_type": "unseen",
        "policy_name": ("xvla", "smolvla")[index % 2],
        "model_name": "checkpoint-30000",
        "success": False,
        "total_steps": 400,
        "annotated_step": steps,
        "initial_state": {
            "joint_vector": rng.uniform(-1, 1, 14).tolist(),
            "left_endpose": end_pose(rng),
            "right_endpose": end_pose(rng),
            "left_gripper": 1.0,
            "right_gripper": 1,
        },
        "actions": rng.uniform(-2.4, 2.4, (steps, 16 if ee else 14)).tolist(),
        "data_type": "OOD_data",
        "error_type": None,
        "s_stage": STAGES[index % 4],
        "d_stage": TYPES[(index + 1) % 4],
        "annotation_meta": {
            "timestamp": "2026-01-01T00:00:00",
            "frame_index": steps,
            "video_fps": 10.5,
            "original_actions_len": 400,
            "saved_actions_len": steps,
            "note": "",
        },
    }
    if ee:
        record["action_type"] = "ee"
    return record


def end_pose(rng: np.random.Generator) -> list[float]:
    """Position and quaternion."""
    pose = rng.uniform(-1, 1, 7)
    pose[3:] /= np.linalg.norm(pose[3:])
    return pose.tolist()


def task_name(platform: str, record: dict) -> str:
    if platform == "libero":
        return f"{record['task_suite_name']}/{record['task_id']}"
    return record["task_name"]


def real_id(suite: str, task: str, episode: int, cell: tuple[str, str], step: int) -> str:
    """An id of the form and length of the paper's release: 18 of its 200 LIBERO test rows have 129 to 146
    characters, those of the tasks with the longest names."""
    stage, deviation = (part.replace(" ", "_") for part in cell)
    return f"{suite}_{task}_ep{episode:02d}_{stage}_{deviation}_{step}"


def write_release(
    root: Path,
    records: dict[str, dict[str, list[dict | str]]],
    newline: str = "\n",
    ids: list[str] | None = None,
    **dump,
) -> Path:
    """Writes a release.

    Args:
        root: its folder.
        records: by platform, by split; a record, or its JSON text.
        newline: of the split tables.
        ids: of the records, in their order, instead of made ones.
        dump: options of `json.dumps`.
    """
    (root / "splits").mkdir(parents=True, exist_ok=True)
    given = iter(ids or ())
    for platform, splits in records.items():
        for split, items in splits.items():
            rows = []
            for i, item in enumerate(items):
                text = item if isinstance(item, str) else json.dumps(item, **dump)
                record = json.loads(text)
                name = next(given, f"{platform}_{split}_{i:04d}")
                path = f"{platform}/{split}/{name}.json"
                (root / path).parent.mkdir(parents=True, exist_ok=True)
                (root / path).write_bytes(text.encode())
                rows.append(
                    {
                        "sample_id": name,
                        "path": path,
                        "sha256": hashlib.sha256(text.encode()).hexdigest(),
                        "original_sha256": hashlib.sha256(name.encode()).hexdigest(),
                        "actions": len(record["actions"]),
                        "replay_prefix_steps": len(record["actions"]),
                        "task_name": task_name(platform, record),
                        "s_stage": record["s_stage"],
                        "d_stage": record["d_stage"],
                    }
                )
            write_table(root, platform, split, rows, newline)
    return root


def write_table(root: Path, platform: str, split: str, rows: list[dict], newline: str = "\n") -> None:
    with open(root / "splits" / f"{platform}_{split}.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator=newline)
        writer.writeheader()
        writer.writerows(rows)


def read_rows(root: Path, platform: str, split: str) -> list[dict]:
    with open(root / "splits" / f"{platform}_{split}.csv", newline="") as file:
        return list(csv.DictReader(file))


def files_of(root: Path) -> dict[str, bytes]:
    """Every file below a folder by its relative path."""
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}
