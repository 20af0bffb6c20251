"""One RoboTwin task, driven through RoboTwin's own code.

What that code does that an evaluation has to know (RoboTwin 2.0):

- `setup_demo` seeds the global generators; see `robotwin_random`.
- `take_action` counts towards a limit that `setup_demo` reads, and silently does nothing once it is reached.
  Replayed actions do not count in a trial, so the limit is taken away; the caller counts.
- `take_action` asks the predicate after every physics substep, stops in mid-action when it holds, and does
  nothing from then on.
- It updates the renderer's copy of the scene after every substep, and renders on success. Both are skipped
  while acting, and done when an image is requested.
- `check_success` of three tasks reads what only the scripted expert sets; see `setup.mend`.
- `envs` must be imported, and scenes built, with the checkout as working directory.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import sys
from collections.abc import Generator
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_roborecover.platforms.robotwin import stubs
from lerobot_roborecover.platforms.robotwin.checkout import EMBODIMENT, RobotwinCheckout
from lerobot_roborecover.platforms.robotwin.random import RandomStreams
from lerobot_roborecover.platforms.robotwin.setup import (
    TaskCode,
    body_names,
    import_task,
    mend,
    quiet,
    setup_arguments,
    without_objects,
    working_in,
)
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.scenario import Pose

if TYPE_CHECKING:
    from sapien import Entity

ARM_JOINTS = 6
_MISSING_ASSET = (FileNotFoundError, ValueError, TypeError, AttributeError, IndexError)
"""What RoboTwin's loaders raise over a model that is not there: some look for it, others go on with None."""


class RobotwinTask:
    """A task's object of RoboTwin's, set up again at every reset.

    Args:
        checkout: whose code runs.
        name: task name, already checked against the checkout.

    Raises:
        SimulatorError: the code cannot be imported, or belongs to another checkout.
    """

    def __init__(self, checkout: RobotwinCheckout, name: str):
        self.checkout, self.name = checkout, name
        self._streams = RandomStreams()
        with working_in(checkout.root):
            self.task: TaskCode = import_task(checkout, name)()
        self._names: dict[Entity, str] = {}

    def setup(
        self, task_config: str, seed: int, instruction: str, scene: contextlib.AbstractContextManager
    ) -> None:
        """Builds the scene of a seed.

        Args:
            task_config: RoboTwin's configuration, e.g. `demo_clean`.
            seed: RoboTwin's seed.
            instruction: text given to the policy.
            scene: how the scene is made (`robotwin_render`).

        Raises:
            SimulatorError: the scene does not come to rest, or cannot be built.
        """
        arguments = setup_arguments(self.checkout, self.name, task_config)
        missing = self.checkout.missing_objects(self.name)
        for attribute in ("_update_render", "get_obs", "arm_tag", "origin_z"):
            self.task.__dict__.pop(attribute, None)
        try:
            with working_in(self.checkout.root), self._streams.fresh(seed), quiet(), _gradients(), scene:
                self.task.setup_demo(now_ep_num=0, seed=seed, is_test=True, **arguments)
        except Exception as err:
            if type(err).__name__ == "UnStableError":
                raise SimulatorError(
                    f"RoboTwin task {self.name}, seed {seed}: the scene does not come to rest ({err}). "
                    "RoboTwin skips such seeds, and so must a scenario: use another seed"
                ) from err
            if isinstance(err, _MISSING_ASSET) and missing:
                raise SimulatorError(
                    f"RoboTwin task {self.name} needs object models that are not there: "
                    f"{', '.join(missing)}. Download RoboTwin's objects archive: "
                    f"{self.checkout.download_command('objects')}. Tasks that need none: "
                    f"{', '.join(without_objects(self.checkout))}"
                ) from err
            if isinstance(err, FileNotFoundError):
                raise SimulatorError(
                    f"RoboTwin task {self.name}, configuration {task_config}, needs {err.filename}, which is "
                    f"not in {self.checkout.root}. Download RoboTwin's assets"
                ) from err
            raise
        task = self.task
        task.step_lim = None
        task.set_instruction(instruction)
        if not stubs.has_curobo():
            task.play_once = stubs.refuse_expert
        for arm in ("left", "right"):
            joints = len(getattr(task.robot, f"{arm}_arm_joints"))
            if joints != ARM_JOINTS:
                raise SimulatorError(
                    f"the {arm} arm has {joints} joints; only {EMBODIMENT} with {ARM_JOINTS} is supported"
                )
        mend(task, self.name)
        self._names = body_names(task)

    def act(self, action: np.ndarray, kind: str) -> None:
        """Executes one action.

        Args:
            action: (14,) joint targets or (16,) end-effector poses, as RoboTwin takes them.
            kind: RoboTwin's `qpos` or `ee`.
        """
        task = self.task
        if not getattr(task, "crazy_random_light", False):  # its lights draw from the task's stream
            task._update_render = _nothing
        task.get_obs = _nothing
        try:
            with self._streams.own(), quiet(), _gradients():
                task.take_action(action, action_type=kind)
        finally:
            task.__dict__.pop("_update_render", None)
            task.__dict__.pop("get_obs", None)

    def observation(self) -> dict[str, Any]:
        """RoboTwin's own observation: renders."""
        with self._streams.own(), quiet():
            return self.task.get_obs()

    def joint_state(self) -> np.ndarray:
        """(14,) float64: six drive targets (radians) and gripper opening (0 to 1) of the left, then the right
        arm; RoboTwin's `joint_action.vector`."""
        robot = self.task.robot
        return np.array(
            [float(v) for v in robot.get_left_arm_jointState() + robot.get_right_arm_jointState()]
        )

    def end_effectors(self) -> np.ndarray:
        """(16,) float64: per arm, position (m), quaternion as RoboTwin orders it (wxyz), gripper opening."""
        task, robot = self.task, self.task.robot
        return np.array(
            [
                *task.get_arm_pose("left"),
                robot.get_left_gripper_val(),
                *task.get_arm_pose("right"),
                robot.get_right_gripper_val(),
            ],
            dtype=np.float64,
        )

    def bodies(self) -> dict[str, Pose]:
        """Fingertip centres (`eef_left`, `eef_right`) and everything that can move but the robot."""
        robot = self.task.robot
        poses = {
            "eef_left": _pose(robot.get_left_tcp_pose()),
            "eef_right": _pose(robot.get_right_tcp_pose()),
        }
        for entity, name in self._names.items():
            pose = entity.get_pose()
            poses[name] = _pose([*pose.p, *pose.q])
        return poses

    def state_sha256(self) -> str:
        """Hash of the physics state and of what the continuation reads in Python."""
        digest = hashlib.sha256(self.task.scene.physx_system.pack())
        digest.update(json.dumps(self._scalars(), sort_keys=True).encode())
        return digest.hexdigest()

    def snapshot(self) -> bytes:
        """State for `restore`: exact at once, drifting by up to 1 mm while an object is held, because PhysX
        does not give out its contacts' warm start."""
        head = {"scalars": self._scalars(), "random": self._streams.numpy_state()}
        header = json.dumps(head).encode()
        return len(header).to_bytes(8, "little") + header + self.task.scene.physx_system.pack()

    def restore(self, snapshot: bytes) -> None:
        """Puts a snapshot of the same task and seed back.

        Raises:
            SimulatorError: it is not one.
        """
        try:
            size = int.from_bytes(snapshot[:8], "little")
            head = json.loads(snapshot[8 : 8 + size])
            self.task.scene.physx_system.unpack(snapshot[8 + size :])
            scalars, stream = head["scalars"], head["random"]
        except (ValueError, KeyError, RuntimeError) as err:
            raise SimulatorError(
                f"the snapshot is not one of RoboTwin task {self.name} ({err}); replay instead"
            ) from err
        for name, value in scalars["task"].items():
            setattr(self.task, name, value)
        self.task.robot.left_gripper_val, self.task.robot.right_gripper_val = scalars["grippers"]
        self._streams.set_numpy_state(stream)

    def _scalars(self) -> dict[str, Any]:
        """Plain values the continuation may read: the task's counters, flags and stage tags, and how far the
        grippers are open."""
        plain = {k: v for k, v in vars(self.task).items() if isinstance(v, (bool, int, float))}
        plain |= {k: v.item() for k, v in vars(self.task).items() if isinstance(v, np.generic)}
        robot = self.task.robot
        grippers = [float(robot.left_gripper_val), float(robot.right_gripper_val)]
        return {"task": {k: v for k, v in plain.items() if k != "FRAME_IDX"}, "grippers": grippers}


def _pose(values: Any) -> Pose:
    """Position and wxyz quaternion, normalised: SAPIEN's are float32."""
    x, y, z, qw, qx, qy, qz = (float(v) for v in values)
    quat = np.array([qx, qy, qz, qw])
    return Pose((x, y, z), tuple(quat / np.linalg.norm(quat)))


@contextlib.contextmanager
def _gradients() -> Generator[None]:
    """curobo optimises with torch's gradients, which an evaluation loop switches off around us."""
    torch = sys.modules.get("torch")
    with torch.enable_grad() if torch is not None else contextlib.nullcontext():
        yield


def _nothing(*_: Any, **__: Any) -> None:
    return None
