from __future__ import annotations

import os

import numpy as np
from curobo.types.math import Pose as CuroboPose
from mplib.sapien_utils import SapienPlanner, SapienPlanningWorld
from transforms3d.euler import quat2euler
from transforms3d.quaternions import mat2quat, quat2mat

TCP_OFFSET_M = 0.11
HAND_TO_TCP = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""RoboTwin's gripper frame has x along the approach; the gantry's hand points along its -z."""


class Robot:
    """Two gantry arms in one articulation."""

    def __init__(self, scene, robot_file, config):
        loader = scene.create_urdf_loader()
        loader.fix_root_link = True
        entity = loader.load(os.path.join(robot_file, config["urdf_path"]))
        self.left_entity = self.right_entity = entity
        self.scale = config["gripper_scale"]
        for link in entity.get_links():
            link.disable_gravity = True
        for joint in entity.get_active_joints():
            joint.set_drive_property(stiffness=config["stiffness"], damping=config["damping"])
        for index, side in enumerate(("left", "right")):
            arm = [entity.find_joint_by_name(name) for name in config["arm_joints_name"][index]]
            fingers = [(entity.find_joint_by_name(name), 1.0, 0.0) for name in config["gripper_name"][index]]
            setattr(self, f"{side}_arm_joints", arm)
            setattr(self, f"{side}_gripper", fingers)
            setattr(self, f"{side}_gripper_val", 0.0)
            setattr(self, f"{side}_ee", arm[-1])
            setattr(self, f"{side}_camera", entity.find_link_by_name(f"{side}_camera"))
            planner = SapienPlanner(SapienPlanningWorld(scene, [entity]), f"{side}_hand")
            setattr(self, f"{side}_mplib_planner", planner)

    def state(self, side):
        targets = [float(j.get_drive_target()[0]) for j in getattr(self, f"{side}_arm_joints")]
        return [*targets, getattr(self, f"{side}_gripper_val")]

    def get_left_arm_jointState(self):
        return self.state("left")

    def get_right_arm_jointState(self):
        return self.state("right")

    def get_left_gripper_val(self):
        return self.left_gripper_val

    def get_right_gripper_val(self):
        return self.right_gripper_val

    def pose(self, side, offset):
        hand = getattr(self, f"{side}_ee").get_child_link().get_entity_pose()
        rotation = quat2mat(hand.q) @ HAND_TO_TCP
        return [*(hand.p + rotation @ [offset, 0, 0]).tolist(), *mat2quat(rotation).tolist()]

    def get_left_tcp_pose(self):
        return self.pose("left", TCP_OFFSET_M)

    def get_right_tcp_pose(self):
        return self.pose("right", TCP_OFFSET_M)

    def plan(self, side, target):
        """Joint values that put the gripper frame at a pose: closed form on a gantry."""
        CuroboPose.from_list(list(target))
        rotation = quat2mat(target[3:7]) @ HAND_TO_TCP.T
        roll, pitch, yaw = quat2euler(mat2quat(rotation), axes="sxyz")
        return np.array([target[0] - (-0.3 if side == "left" else 0.3), target[1] + 0.3, target[2] - 1.05,
                         yaw, pitch, roll])  # fmt: skip

    def set_arm(self, side, position, velocity):
        for joint, target, speed in zip(getattr(self, f"{side}_arm_joints"), position, velocity, strict=True):
            joint.set_drive_target(target)
            joint.set_drive_velocity_target(speed)

    def set_gripper(self, side, value):
        value = float(np.clip(value, 0, 1))
        setattr(self, f"{side}_gripper_val", value)
        for joint, _, _ in getattr(self, f"{side}_gripper"):
            joint.set_drive_target(self.scale[0] + value * (self.scale[1] - self.scale[0]))
