"""Run by the doctor in a process of its own: renders one red ball with the configured OpenGL."""

from __future__ import annotations

import mujoco
import numpy as np

from lerobot_roborecover.platforms.probe import answer

_SCENE = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="front" pos="0 -1 0" xyaxes="1 0 0 0 0 1"/>
    <geom type="sphere" size=".3" rgba="1 0 0 1"/>
  </worldbody>
</mujoco>
"""


def main() -> None:
    """Answers with the renderer's name and whether the ball is where it should be."""
    model = mujoco.MjModel.from_xml_string(_SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 64, 64) as renderer:
        renderer.update_scene(data, camera="front")
        image = renderer.render().astype(int)
        name = _renderer_name()
    redness = image[..., 0] - np.maximum(image[..., 1], image[..., 2])
    answer({"renderer": name, "correct": bool(redness[32, 32] > 20 and redness[2, 2] < 20)})


def _renderer_name() -> str:
    """The driver's name for itself; empty where PyOpenGL cannot say."""
    try:
        from OpenGL import GL

        name = GL.glGetString(GL.GL_RENDERER)
    except Exception:  # PyOpenGL raises types of its own per platform, and only the name is at stake
        return ""
    return name.decode(errors="replace") if name else ""


if __name__ == "__main__":
    main()
