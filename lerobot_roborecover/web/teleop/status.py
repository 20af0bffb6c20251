"""What is told of a session: in words and numbers for the page, exactly for scripts, and as pictures."""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_roborecover.platforms.controls import AXES
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.scenario import Pose
from lerobot_roborecover.web.teleop.session import TeleopSession

JPEG_QUALITY = 80


def of_session(session: TeleopSession) -> dict[str, Any]:
    """The session's part of a status message."""
    simulator, controls, start = session.simulator, session.controls, session.start_point
    status: dict[str, Any] = {
        "platform": simulator.platform,
        "control_hz": simulator.control_hz,
        "axes": [a for a in AXES if a in controls.columns],
        "gripper": controls.gripper is not None,
        "captions": dict(controls.captions),
    }
    if start is None:
        return status
    mark = session.mark
    eef = next((p for n, p in session.bodies[-1].items() if n.startswith("eef")), None)
    return {
        **status,
        "instruction": start.task.instruction,
        "label": start.label,
        "step": session.step,
        "first_step": len(start.prefix),
        "horizon": start.task.horizon,
        "solved": session.solved[-1],
        "mark": None if mark is None else [mark.step, mark.stage, mark.deviation],
        "proven": session.proven,
        "lacks": session.lacks(),
        "eef_m": None if eef is None else [round(v, 5) for v in eef.position_m],
    }


def exact_state(session: TeleopSession) -> dict[str, Any]:
    """Everything that a script may want to see, exactly."""
    low_dim = getattr(session.simulator, "low_dim", None)
    return {
        "bodies": {n: _list(p) for n, p in session.bodies[-1].items()} if session.bodies else {},
        "low_dim": None if low_dim is None else np.asarray(low_dim()).tolist(),
    }


def encode(picture: np.ndarray) -> bytes:
    """A (H, W, 3) uint8 picture as JPEG."""
    import cv2

    good, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    )
    if not good:
        raise SimulatorError(f"a picture of shape {picture.shape} cannot be encoded")
    return data.tobytes()


def _list(pose: Pose) -> list[float]:
    return [*pose.position_m, *pose.quat_xyzw]
