"""What is read from a Meta-World env and its MuJoCo model: attributes of a step, movable bodies, pictures."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from metaworld.sawyer_xyz_env import SawyerXYZEnv

from lerobot_roborecover.platforms.mujoco_state import subtree
from lerobot_roborecover.platforms.simulator import SimulatorError

STEP_ATTRIBUTES = (
    "pickCompleted",
    "placeCompleted",
    "reachCompleted",
    "_target_to_obj_init",
    "_did_see_sim_exception",
)
"""Python attributes that the fifty tasks' `step` assigns besides observation stack and step counter."""


def step_attributes(env: SawyerXYZEnv) -> dict[str, Any]:
    """The values of those of `STEP_ATTRIBUTES` that the env has."""
    return {name: getattr(env, name) for name in STEP_ATTRIBUTES if hasattr(env, name)}


def set_attributes(env: SawyerXYZEnv, values: Mapping[str, Any]) -> None:
    """Sets attributes of the env, as `step_attributes` has read them."""
    for name, value in values.items():
        setattr(env, name, value)


def xyzw(quat_wxyz: np.ndarray) -> tuple[float, float, float, float]:
    """MuJoCo's quaternion in the order of `Pose`."""
    w, x, y, z = quat_wxyz
    return (x, y, z, w)


def movable_bodies(model: mujoco.MjModel) -> dict[str, int]:
    """Ids by name of the bodies with a joint of their own that are not the robot's.

    Meta-World leaves some of them unnamed (dial, puck, thermos): those go by their nearest named ancestor.
    """
    robot = subtree(model, [model.body("base").id, model.body("mocap").id])
    found: dict[str, int] = {}
    for body in range(1, model.nbody):
        if body in robot or not model.body_jntnum[body]:
            continue
        named = body
        while not model.body(named).name:
            named = int(model.body_parentid[named])
        name = model.body(named).name
        found[name if name not in found else f"{name}.{body}"] = body
    return found


def render_frame(env: SawyerXYZEnv) -> np.ndarray:
    """(H, W, 3) uint8 of the env's camera.

    Raises:
        SimulatorError: OpenGL does not render.
    """
    if sys.platform.startswith("linux") and not (os.environ.get("MUJOCO_GL") or os.environ.get("DISPLAY")):
        os.environ["MUJOCO_GL"] = "egl"  # Gymnasium would take GLFW, which makes no context without a display
    try:
        renderer = env.mujoco_renderer
        if renderer.viewer is not None:
            renderer.viewer.make_context_current()
        return env.render()
    except Exception as err:  # each OpenGL backend raises its own types
        raise SimulatorError(
            f"Meta-World could not render ({type(err).__name__}: {err}) with MUJOCO_GL="
            f"{os.environ.get('MUJOCO_GL', '')!r}. Install EGL (Debian: libegl1 libegl-mesa0 "
            "libgl1-mesa-dri) or OSMesa (libosmesa6, MUJOCO_GL=osmesa), or use obs_type='state', which needs "
            "no OpenGL"
        ) from err
