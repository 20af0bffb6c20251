"""What RoboTwin's observations and actions need on their way to and from policies whose release reads them in
another form than LeRobot's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ObservationProcessorStep, PolicyProcessorPipeline, ProcessorStep
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE
from scipy.spatial.transform import Rotation
from torch.nn.functional import interpolate

type Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]

MOSAIC = "mosaic"
"""Name of the picture made of all three cameras."""
MOSAIC_SIZE = (384, 320)
"""Its rows and columns."""
ENDPOSE = "observation.endpose"
_HEAD, _WRIST = (256, 320), (128, 160)
_GRIPPER_CLOSES_ABOVE = 0.7


@dataclass
class CameraMosaicStep(ObservationProcessorStep):
    """All three cameras in one picture, as Fast-WAM was trained: head above, left and right wrist below.

    Sizes and order are those of yuantianyuan01/FastWAM at 3a5ff3c,
    `experiments/robotwin/fastwam_policy/deploy_policy.py`.
    """

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Replaces the three pictures, (B, 3, H, W) floats, by (B, 3, 384, 320)."""
        out = dict(observation)
        head, left, right = (
            interpolate(
                out.pop(f"{OBS_IMAGES}.{name}_camera"), size, mode="bilinear", antialias=True
            )  # PIL's bilinear, which the release uses, is antialiased
            for name, size in (("head", _HEAD), ("left", _WRIST), ("right", _WRIST))
        )
        out[f"{OBS_IMAGES}.{MOSAIC}"] = torch.cat([head, torch.cat([left, right], dim=-1)], dim=-2)
        return out

    def transform_features(self, features: Features) -> Features:
        """LeRobot asks for it; features are declared by the env config."""
        return features


@dataclass
class XVLAStateStep(ObservationProcessorStep):
    """X-VLA's proprioception on RoboTwin, from both arms' end-effector poses.

    Per arm: position, the first two columns of the rotation matrix row by row, 1 - 2 x gripper opening; as in
    `evaluation/robotwin-2.0/client.py` of 2toinf/X-VLA at 6bc2513. RoboTwin's quaternions go through scipy in
    the order they come, there and back, as X-VLA was trained.
    """

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Replaces `observation.endpose`, (B, 16), by `observation.state`, (B, 20)."""
        out = dict(observation)
        poses = out.pop(ENDPOSE).cpu().numpy().astype(np.float64)
        arms = []
        for arm in (poses[:, :8], poses[:, 8:]):
            columns = Rotation.from_quat(arm[:, 3:7]).as_matrix()[:, :, :2].reshape(-1, 6)
            arms += [arm[:, :3], columns, 1 - 2 * arm[:, 7:8]]
        out[OBS_STATE] = torch.from_numpy(np.concatenate(arms, axis=1)).float()
        return out

    def transform_features(self, features: Features) -> Features:
        """LeRobot asks for it; features are declared by the env config."""
        return features


@dataclass
class XVLAActionStep(ProcessorStep):
    """X-VLA's 20 values to RoboTwin's 16: absolute end-effector poses, grippers open (1) or closing (-1).

    The inverse of `XVLAStateStep`'s rotation, and the release's gripper threshold.
    """

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Converts the (B, 20) action.

        Raises:
            ValueError: the action is no tensor, or has another width.
        """
        action = transition[TransitionKey.ACTION.value]
        if not isinstance(action, torch.Tensor):
            raise ValueError(f"X-VLA's end-effector action is a tensor (B, 20), got {type(action).__name__}")
        if action.shape[-1] != 20:
            raise ValueError(
                f"X-VLA's end-effector action has 20 values, this checkpoint gives {action.shape[-1]}. A "
                "checkpoint of joint actions runs with --env.action_mode=joint"
            )
        values = action.detach().cpu().numpy().astype(np.float64)
        arms = []
        for arm in (values[:, :10], values[:, 10:]):
            closing = arm[:, 9:10] > _GRIPPER_CLOSES_ABOVE
            arms += [arm[:, :3], _quaternions(arm[:, 3:9]), np.where(closing, -1.0, 1.0)]
        out = transition.copy()
        out[TransitionKey.ACTION.value] = torch.from_numpy(np.concatenate(arms, axis=1))
        return out

    def transform_features(self, features: Features) -> Features:
        """LeRobot asks for it; features are declared by the env config."""
        return features


def _quaternions(columns: np.ndarray) -> np.ndarray:
    """(B, 4) of (B, 6) matrix columns that need not be orthonormal."""
    first, second = columns[:, 0::2], columns[:, 1::2]
    x = first / np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    y = second - (x * second).sum(1, keepdims=True) * x
    y /= np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-12)
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1)).as_quat()


def xvla_processors() -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Env processors of an X-VLA that moves end effectors."""
    return PolicyProcessorPipeline(steps=[XVLAStateStep()]), PolicyProcessorPipeline(steps=[XVLAActionStep()])


def mosaic_processors() -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Env processors of a policy that sees one picture of all cameras."""
    return PolicyProcessorPipeline(steps=[CameraMosaicStep()]), PolicyProcessorPipeline(steps=[])
