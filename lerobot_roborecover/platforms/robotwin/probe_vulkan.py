"""Run by the doctor in a process of its own, which a bad driver may end: renders one red box with SAPIEN."""

from __future__ import annotations

import sapien

from lerobot_roborecover.platforms.probe import answer


def main() -> None:
    """Answers with the device's name and whether the box is where it should be."""
    sapien.render.set_camera_shader_dir("trivial")
    scene = sapien.Scene()
    scene.set_ambient_light([1, 1, 1])
    builder = scene.create_actor_builder()
    builder.add_box_visual(half_size=[0.1, 0.1, 0.1], material=[1, 0, 0])
    builder.build_kinematic(name="box").set_pose(sapien.Pose([1, 0, 0]))
    camera = scene.add_camera("camera", 64, 64, 1.0, 0.1, 10)
    scene.update_render()
    camera.take_picture()
    picture = camera.get_picture("Color")
    device = getattr(sapien.render.RenderSystem().device, "name", "") or "a Vulkan device"
    centre, corner = picture[32, 32], picture[2, 2]
    answer({"device": device, "correct": bool(centre[0] - centre[1] > 0.5 and corner[0] - corner[1] < 0.1)})


if __name__ == "__main__":
    main()
