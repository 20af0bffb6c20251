"""A robot's fingerprint: the same robot is the same, another one is named before anything is a mismatch."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.datasets.release.initial_state import check_robot
from lerobot_roborecover.evaluation.session_checks import check_versions
from lerobot_roborecover.platforms import SimulatorError, make_simulator
from lerobot_roborecover.platforms.fake.simulator import FakeSimulator
from lerobot_roborecover.platforms.robot_fingerprint import SAME, compare_robots
from lerobot_roborecover.platforms.robotwin.checkout import RobotwinCheckout
from lerobot_roborecover.platforms.robotwin.robot import SETTINGS, RobotwinRobot
from lerobot_roborecover.platforms.urdf import Urdf
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.scenario import ScenarioError
from tests.support.robotwin_checkouts import REAL, ROOT, STANDIN, on_real

SHIPPED = list(load_scenarios("robotwin_starter"))
MOUNTS = {  # RoboTwin's own, and those of the public robot that its arms come from
    ("0.2305 0.297 0.782", "0.0 0.0 0.02"): ("0.233 0.3 0.7775", "0.0 0.0 0.0"),
    ("0.2315 -0.3063 0.781", "0.0 0.0 0.01"): ("0.233 -0.3 0.7775", "0.0 0.0 0.0"),
}


def embodiment(root: Path) -> Path:
    return root / "assets" / "embodiments" / "aloha-agilex"


def moved(folder: Path, old: str, new: str) -> Path:
    """A copy of an embodiment's URDF with one text changed, in place."""
    urdf = next(folder.rglob("*.urdf"))
    text = urdf.read_text()
    assert old in text, old
    urdf.write_text(text.replace(old, new, 1))
    return folder


@pytest.fixture
def other_root(tmp_path):
    """The checkout with its left arm mounted 6 mm further to the left."""
    root = tmp_path / "RoboTwin"
    root.mkdir()
    for entry in Path(ROOT).iterdir():
        if entry.name not in ("assets", ".git"):
            (root / entry.name).symlink_to(entry)
    shutil.copytree(Path(ROOT) / "assets" / "embodiments", root / "assets" / "embodiments")
    (root / "assets" / "objects").symlink_to(Path(ROOT) / "assets" / "objects")
    if REAL:
        moved(embodiment(root), "0.2305 0.297 0.782", "0.2305 0.303 0.782")
    else:
        moved(embodiment(root), "-0.3 -0.3 1.05", "-0.306 -0.3 1.05")
    return root


def recorded_here(scenario):
    """A scenario as if it had been recorded on the robot of the tests' checkout."""
    mark = scenario.fingerprint
    versions = {k: v for k, v in mark.versions.items() if not k.startswith("robot")}
    versions |= RobotwinCheckout(ROOT).robot.fingerprint
    return replace(scenario, fingerprint=replace(mark, versions=versions))


def test_forward_kinematics_of_a_hand_worked_arm(tmp_path):
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(
        """<robot name="r"><link name="base"/><link name="a"/><link name="b"/><link name="c"/>
        <joint name="turn" type="revolute"><parent link="base"/><child link="a"/>
          <origin xyz="1 0 0" rpy="0 0 1.5707963267948966"/><axis xyz="0 0 2"/>
          <limit lower="-1" upper="1"/></joint>
        <joint name="slide" type="prismatic"><parent link="a"/><child link="b"/><origin xyz="0.5 0 0"/>
          <axis xyz="1 0 0"/></joint>
        <joint name="tip" type="fixed"><parent link="b"/><child link="c"/><origin xyz="0 0 0.25"/></joint>
        </robot>"""
    )
    arm = Urdf(urdf)
    assert arm.pose("tip", {})[:3, 3] == pytest.approx([1, 0.5, 0.25])
    out = arm.pose("tip", {"turn": np.pi / 2, "slide": 0.1})  # half a turn in all
    assert out[:3, 3] == pytest.approx([0.4, 0, 0.25])
    assert out[:3, :3] == pytest.approx(np.diag([-1, -1, 1]))
    spelt = tmp_path / "spelt.urdf"
    spelt.write_text(urdf.read_text().replace('"0.5 0 0"', '"+.50 0.0 -0"').replace("link", "link "))
    assert Urdf(spelt).kinematics_sha256() == arm.kinematics_sha256()
    urdf.write_text(urdf.read_text().replace('"0.5 0 0"', '"0.501 0 0"'))
    assert Urdf(urdf).kinematics_sha256() != arm.kinematics_sha256()
    for broken in ("<robot", "<robot><joint name='x' type='fixed'><child link='a'/></joint></robot>"):
        urdf.write_text(broken)
        with pytest.raises(SimulatorError, match=r"arm\.urdf cannot be read"):
            Urdf(urdf)


@pytest.mark.robotwin
def test_the_files_give_the_poses_that_the_simulator_has():
    from lerobot_roborecover.scenario import Reset, Task

    simulator = make_simulator("robotwin", robotwin_root=ROOT, obs_type="state")
    simulator.reset(Task("robotwin", "demo_clean", "stack_blocks_two", "x", 800), Reset(seed=3))
    robot = simulator.robotwin_task.task.robot
    entity = robot.left_entity
    names = [joint.name for joint in entity.get_active_joints()]
    for values in SETTINGS.values():
        qpos = entity.get_qpos()
        for side in ("left", "right"):
            for joint, value in zip(getattr(robot, f"{side}_arm_joints"), values, strict=True):
                qpos[names.index(joint.name)] = value
        entity.set_qpos(qpos)
        for side in ("left", "right"):
            link = getattr(robot, f"{side}_arm_joints")[-1].get_child_link()
            there = link.get_entity_pose().to_transformation_matrix()
            np.testing.assert_allclose(simulator.checkout.robot.end(side, values), there, atol=2e-6)
    simulator.close()


def test_what_is_a_difference_and_what_is_not():
    here = {"robot": "r", "robot_kinematics": "k", "robot_fk.left.1": "0 0 0 1 0 0 0 1 0"}
    here |= {"robot_mesh.hand.stl": "m", "robot_mesh.base.stl": "b"}
    assert compare_robots({}, here).known is False, "recorded before robots were"
    assert compare_robots(here, {}).known is False
    assert compare_robots(here, here) == SAME
    assert compare_robots({**here, "robot_fk.left.1": "0 0.00009 0 1 0 0 0 1 0"}, here) == SAME
    assert compare_robots({**here, "robot_mesh.base.stl": "missing"}, here) == SAME, "left out where recorded"
    assert compare_robots({k: v for k, v in here.items() if "base" not in k}, here) == SAME
    off = compare_robots({**here, "robot_fk.left.1": "0 0.006 0 1 0 0 0 1 0"}, here)
    assert str(off) == "its left end is 6.00 mm and 0.0000 rad elsewhere at joint setting 1"
    assert off.another
    assert compare_robots({**here, "robot_fk.left.1": "nonsense"}, here).another
    lesser = compare_robots({**here, "robot_kinematics": "j", "robot_mesh.hand.stl": "n"}, here)
    assert not lesser.another
    assert str(lesser) == "its joints' hash is k, not j; its mesh hand.stl is m, not n"


def test_every_handoff_names_the_other_robot_before_it_resets_anything(other_root):
    simulator = make_simulator("robotwin", robotwin_root=str(other_root), obs_type="state")
    scenario = recorded_here(SHIPPED[0])
    with pytest.raises(SimulatorError) as refused:
        hand_off(simulator, scenario)
    text = str(refused.value)
    assert text.startswith("the robot aloha-agilex here is another than the one that recorded scenario ")
    assert scenario.id in text
    assert "its left end is 6.00 mm and 0.0000 rad elsewhere" in text
    assert "right end" not in text
    assert "roborecover doctor --platform robotwin" in text
    assert "\n" not in text


def test_the_protocol_does_not_ask_which_platform(monkeypatch):
    from lerobot_roborecover.replay.handoff import with_fingerprint
    from tests.support.factories import fake_scenario

    simulator = FakeSimulator()
    entry = "robot_fk.arm.1"
    monkeypatch.setattr(simulator, "fingerprint", lambda: {"robot": "r", entry: "0 0 0 1 0 0 0 1 0"})
    scenario = with_fingerprint(simulator, fake_scenario(0))
    assert hand_off(simulator, scenario).identical
    monkeypatch.setattr(simulator, "fingerprint", lambda: {"robot": "r", entry: "0 0 1 1 0 0 0 1 0"})
    with pytest.raises(SimulatorError, match=r"arm end is 1000\.00 mm"):
        hand_off(simulator, scenario)
    assert hand_off(simulator, scenario, check=False).problem is None


def test_a_run_is_refused_before_it_starts(other_root, caplog):
    from lerobot_roborecover.errors import OptionError

    scenarios = [recorded_here(s) for s in SHIPPED[:3]]
    here = RobotwinCheckout(other_root).robot.fingerprint
    with pytest.raises(
        OptionError, match=r"\(and 2 more\) was recorded on another robot than the aloha-agilex"
    ):
        check_versions(scenarios, "robotwin", here, True)
    check_versions(scenarios, "robotwin", RobotwinCheckout(ROOT).robot.fingerprint, True)
    assert "robot" not in caplog.text
    mark = scenarios[0].fingerprint
    versions = {k: v for k, v in mark.versions.items() if not k.startswith("robot")}
    old = replace(scenarios[0], fingerprint=replace(mark, versions=versions))
    check_versions([old], "robotwin", here, True)
    assert "does not say which robot recorded it" in caplog.text
    caplog.clear()
    meshes = {**here, **RobotwinCheckout(ROOT).robot.fingerprint, "robot_mesh.hand.stl": "n"}
    was = {**mark.versions, "robot_mesh.hand.stl": "m"}
    check_versions([replace(old, fingerprint=replace(mark, versions=was))], "robotwin", meshes, True)
    assert "its mesh hand.stl is n, not m" in caplog.text


@pytest.mark.parametrize("joints", ["home", "elsewhere"])
def test_a_record_with_all_joints_at_0_checks_the_robot(joints):
    """`endpose` is then forward kinematics alone. The other robot's wrists are 6 mm away."""
    robot = RobotwinRobot(embodiment(STANDIN))
    said = {"joint_vector": [0.0] * 6 + [1.0] + [0.0] * 6 + [1.0]}
    for side in ("left", "right"):
        said[f"{side}_endpose"] = [*robot.end(side, [0.0] * 6)[:3, 3], 1, 0, 0, 0]
    assert max(check_robot(robot, said).values()) < 1e-9
    said["right_endpose"][0] += 0.006
    if joints == "elsewhere":
        said["joint_vector"][2] = 0.01
        assert check_robot(robot, said) is None
        return
    with pytest.raises(ScenarioError, match=r"its right wrist is 6\.00 mm away") as refused:
        check_robot(robot, said)
    assert "left" not in str(refused.value)
    assert "roborecover doctor" in str(refused.value)


def test_conversion_refuses_the_records_of_another_robot_without_replaying(tmp_path, capsys, monkeypatch):
    from tests.support.conversion_scripts import script
    from tests.support.release_files import robotwin_record, write_release

    robot = RobotwinRobot(embodiment(Path(ROOT)))
    records = []
    for index, off_m in enumerate((0.0, 0.006)):
        record = robotwin_record(index)
        state = {
            "joint_vector": [0.0] * 6 + [1.0] + [0.0] * 6 + [1.0],
            "left_gripper": 1.0,
            "right_gripper": 1.0,
        }
        for side in ("left", "right"):
            x, y, z = robot.end(side, [0.0] * 6)[:3, 3]
            state[f"{side}_endpose"] = [x, y + off_m, z, 1.0, 0.0, 0.0, 0.0]
        records.append({**record, "initial_state": state})
    release = write_release(tmp_path / "release", {"robotwin": {"test": records}})
    convert = script("roborecover_release").main
    monkeypatch.setenv("ROBOTWIN_ROOT", ROOT)
    assert convert([str(release), "--out", str(tmp_path / "out")]) == 1
    refusal = capsys.readouterr().err
    assert "robotwin_test_0001.json: field initial_state: the robot" in refusal
    assert "its left wrist is 6.00 mm away and its right wrist is 6.00 mm away" in refusal
    report = json.loads((tmp_path / "out/robotwin/meta/roborecover/conversion.json").read_text())
    assert (report["scenarios"], len(report["refused"])) == (1, 1)
    monkeypatch.delenv("ROBOTWIN_ROOT")
    assert convert([str(release), "--out", str(tmp_path / "again")]) == 0, "without a robot, none is compared"


@on_real
def test_the_robot_is_the_paper_s_and_the_shipped_set_s():
    robot = RobotwinCheckout(ROOT).robot
    found = robot.from_released_mm()
    print("wrists, mm from the paper's example record:", found)
    assert max(found.values()) < 0.0054
    assert compare_robots(SHIPPED[0].fingerprint.versions, robot.fingerprint) == SAME


@on_real
def test_the_robot_that_the_first_set_was_recorded_on_is_named(other_root):
    shutil.rmtree(embodiment(other_root))
    shutil.copytree(embodiment(Path(ROOT)), embodiment(other_root))
    for (xyz, rpy), (old_xyz, old_rpy) in MOUNTS.items():
        moved(embodiment(other_root), f'xyz="{xyz}" rpy="{rpy}"', f'xyz="{old_xyz}" rpy="{old_rpy}"')
    checkout = RobotwinCheckout(other_root)
    found = checkout.robot.from_released_mm()
    assert 4 < min(found.values()) < max(found.values()) < 9, found
    simulator = make_simulator("robotwin", robotwin_root=str(other_root), obs_type="state")
    for scenario in SHIPPED:
        with pytest.raises(SimulatorError, match="another than the one that recorded") as refused:
            hand_off(simulator, scenario)
    print(refused.value)
