from __future__ import annotations

import os

import numpy as np
import sapien.core as sapien
import torch
import yaml

from ._GLOBAL_CONFIGS import CONFIGS_PATH
from .robot import Robot
from .utils import UnStableError, create_box

UNSTABLE_SEEDS = (13,)
TABLE_HEIGHT_M = 0.74


class Base_Task:
    """The part of RoboTwin's task API that an evaluation uses."""

    def _init_task_env_(self, **kwargs):
        np.random.seed(kwargs["seed"])
        torch.manual_seed(kwargs["seed"])
        self.seed = kwargs["seed"]
        self.task_name = kwargs["task_name"]
        self.data_type = kwargs["data_type"]
        self.step_lim = None
        self.take_action_cnt = 0
        self.eval_success = False
        self.setup_scene()
        create_box(self, sapien.Pose([0, 0, TABLE_HEIGHT_M - 0.025]), [0.6, 0.35, 0.025], (0.9, 0.9, 0.9),
                   "table", is_static=True)  # fmt: skip
        self.robot = Robot(self.scene, kwargs["left_robot_file"], kwargs["left_embodiment_config"])
        self.load_camera()
        for _ in range(50):
            for side in ("left", "right"):
                self.robot.set_gripper(side, 1.0)
            self.scene.step()
        self.load_actors()
        if self.seed in UNSTABLE_SEEDS:  # a tall plank on its edge, leaning
            create_box(self, sapien.Pose([0, 0.2, 0.85], [0.98, 0.199, 0, 0]), [0.1, 0.005, 0.1], (0, 0, 0),
                       "plank")  # fmt: skip
        self.check_stable()
        if kwargs.get("eval_mode"):
            with open(os.path.join(CONFIGS_PATH, "_eval_step_limit.yml")) as file:
                self.step_lim = yaml.safe_load(file)[self.task_name]
        self.stage_success_tag = False

    def setup_scene(self):
        engine = sapien.Engine()
        renderer = sapien.SapienRenderer()
        engine.set_renderer(renderer)
        sapien.render.set_camera_shader_dir("rt")
        sapien.render.set_ray_tracing_samples_per_pixel(32)
        sapien.render.set_ray_tracing_denoiser("oidn")
        self.scene = engine.create_scene(sapien.SceneConfig())
        self.scene.set_timestep(1 / 250)
        self.scene.add_ground(0)
        self.scene.default_physical_material = self.scene.create_physical_material(1.0, 1.0, 0)
        self.scene.set_ambient_light([0.5, 0.5, 0.5])
        self.scene.add_directional_light([0, 0.5, -1], [0.5, 0.5, 0.5], shadow=True)

    def load_camera(self):
        view = {}
        for name in ("head_camera", "left_camera", "right_camera"):
            view[name] = self.scene.add_camera(
                name=name, width=320, height=240, fovy=np.deg2rad(60), near=0.05, far=100
            )
        forward, left = np.array([0, 0.6, -0.8]), np.array([-1.0, 0, 0])
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([forward, left, np.cross(forward, left)], axis=1)
        matrix[:3, 3] = [0, -0.45, 1.5]
        view["head_camera"].entity.set_pose(sapien.Pose(matrix))
        self.view = view

    def check_stable(self):
        dynamic = self.scene.physx_system.rigid_dynamic_components
        before = {body: body.entity.get_pose() for body in dynamic}
        for _ in range(400):
            self.scene.step()
        moved = [
            body.entity.name
            for body, pose in before.items()
            if abs(np.dot(pose.q, body.entity.get_pose().q)) < np.cos(np.deg2rad(1.5))
        ]
        if moved:
            raise UnStableError(f"Objects is unstable in seed({self.seed}), unstable objects: {moved}")

    def set_instruction(self, instruction=None):
        self.instruction = instruction

    def get_arm_pose(self, side):
        return self.robot.pose(side, 0.0)

    def is_left_gripper_open(self):
        return self.robot.left_gripper_val > 0.8

    def is_right_gripper_open(self):
        return self.robot.right_gripper_val > 0.8

    def _update_render(self):
        for side in ("left", "right"):
            camera = getattr(self.robot, f"{side}_camera")
            self.view[f"{side}_camera"].entity.set_pose(camera.get_entity_pose())
        self.scene.update_render()

    def get_obs(self):
        self._update_render()
        pictures = {}
        for name, camera in self.view.items():
            camera.take_picture()
            rgba = (camera.get_picture("Color") * 255).clip(0, 255).astype("uint8")
            pictures[name] = {"rgb": rgba[:, :, :3]}
        return {"observation": pictures}

    def take_action(self, action, action_type="qpos"):
        if self.take_action_cnt == self.step_lim or self.eval_success:
            return
        self.take_action_cnt += 1
        print(f"step: {self.take_action_cnt} / {self.step_lim}", end="\r")
        self._update_render()
        width = 7 if action_type == "qpos" else 8
        plans = {}
        for index, side in enumerate(("left", "right")):
            goal = np.asarray(action[index * width : (index + 1) * width])
            state = np.array(self.robot.state(side))
            arm = goal[:-1] if action_type == "qpos" else self.robot.plan(side, goal[:-1])
            planner = getattr(self.robot, f"{side}_mplib_planner")
            try:
                _, position, velocity, _, _ = planner.TOPP(np.vstack((state[:-1], arm)), 1 / 250)
            except Exception:
                position = velocity = np.zeros((0, 6))
            steps = len(position) or 50
            plans[side] = position, velocity, np.linspace(state[-1], goal[-1], steps + 1)[1:]
        for step in range(max(len(plan[2]) for plan in plans.values())):
            for side, (position, velocity, gripper) in plans.items():
                if step < len(position):
                    self.robot.set_arm(side, position[step], velocity[step])
                if step < len(gripper):
                    self.robot.set_gripper(side, gripper[step])
            self.scene.step()
            self._update_render()
            if self.check_success():
                self.eval_success = True
                self.get_obs()
                return
        self._update_render()

    def play_once(self):
        raise NotImplementedError
