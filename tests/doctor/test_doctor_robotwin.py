"""`roborecover doctor --platform robotwin`: each line, and its remedy."""

from __future__ import annotations

import shutil

import pytest

from lerobot_roborecover.doctor.sources import recorded_by
from lerobot_roborecover.platforms import platform_named, versions
from lerobot_roborecover.platforms.findings import Status
from lerobot_roborecover.platforms.robotwin import checks as robotwin
from tests.support.robotwin_checkouts import STANDIN

RECORDED = recorded_by(platform_named("robotwin"))


def by_name(checks) -> dict:
    return {check.name: check for check in checks}


@pytest.mark.parametrize(("required", "status"), [(True, Status.FAILURE), (False, Status.WARNING)])
def test_no_checkout(monkeypatch, required, status):
    monkeypatch.delenv("ROBOTWIN_ROOT", raising=False)
    (check,) = robotwin.check_checkout(required, {})
    assert check.status is status
    assert "ROBOTWIN_ROOT" in check.remedy


def test_a_checkout_its_robot_and_its_objects(monkeypatch, tmp_path):
    root = shutil.copytree(STANDIN, tmp_path / "RoboTwin")
    (root / ".git").mkdir()
    (root / ".git" / "HEAD").write_text("c" * 40)
    monkeypatch.setenv("ROBOTWIN_ROOT", str(root))
    checks = by_name(robotwin.check_checkout(True, RECORDED))
    assert checks["RoboTwin checkout"].status is Status.OK
    assert "c" * 12 in checks["RoboTwin checkout"].detail
    assert "task_config" in checks["RoboTwin checkout"].detail
    robot = checks["RoboTwin robot"]
    assert robot.status is Status.FAILURE, "the stand-in's robot is another than the paper's"
    assert "is another than the paper's: with all joints at 0 its left wrist is" in robot.detail
    assert "its right end is" in robot.detail
    assert "embodiments.zip" in robot.remedy
    objects = checks["RoboTwin objects"]
    assert objects.status is Status.WARNING
    assert "2 of 3" in objects.detail
    assert "click_bell" in objects.detail
    assert f"cd {root}/assets && hf download TianxingChen/RoboTwin2.0 objects.zip" in objects.remedy

    (root / "assets" / "objects" / "050_bell").mkdir()
    shutil.rmtree(root / "assets" / "embodiments")
    checks = by_name(robotwin.check_checkout(True, RECORDED))
    assert checks["RoboTwin objects"].status is Status.OK
    assert checks["RoboTwin robot"].status is Status.FAILURE
    assert "embodiments.zip" in checks["RoboTwin robot"].remedy


def test_the_robot_is_the_paper_s_and_the_one_that_recorded_the_shipped_set(monkeypatch):
    """Here with the stand-in's robot in their place."""
    from lerobot_roborecover.platforms.robotwin import robot as robotwin_robot
    from lerobot_roborecover.platforms.robotwin.checkout import RobotwinCheckout

    checkout = RobotwinCheckout(STANDIN)
    home = {side: tuple(checkout.robot.end(side, [0.0] * 6)[:3, 3]) for side in ("left", "right")}
    monkeypatch.setattr(robotwin_robot, "RELEASED_ENDS_M", home)
    versions = dict(checkout.robot.fingerprint)

    def check():
        return robotwin.check_robot(checkout, Status.FAILURE, versions)

    assert (check().status, check().remedy) == (Status.OK, "")
    assert "wrists 0.0000 mm from where the paper's release has them" in check().detail
    versions["robot_kinematics"] = "0" * 16
    assert check().status is Status.WARNING
    assert "its joints' hash is" in check().detail
    x, *others = versions["robot_fk.right.2"].split()
    versions["robot_fk.right.2"] = " ".join([str(float(x) + 0.007), *others])
    assert check().status is Status.FAILURE
    assert "its right end is 7.00 mm and 0.0000 rad elsewhere at joint setting 2" in check().detail
    versions.clear()
    assert check().status is Status.OK
    assert "the shipped set has no robot to compare with" in check().detail


def test_vulkan(monkeypatch):
    monkeypatch.setattr(versions, "installed", lambda name: "3.0.3")
    monkeypatch.setenv("VK_ICD_FILENAMES", "lvp_icd.json")
    good = robotwin.check_vulkan({"device": "llvmpipe", "correct": True}, True)
    assert good.status is Status.OK
    assert "llvmpipe" in good.detail
    assert "lvp_icd.json" in good.detail
    for probe in ({"error": "failed to find a rendering device"}, {"device": "x", "correct": False}):
        bad = robotwin.check_vulkan(probe, True)
        assert bad.status is Status.WARNING
        assert "render_quality=trivial" in bad.remedy
        assert "obs_type=state" in bad.remedy
    monkeypatch.setattr(versions, "installed", lambda name: None)
    assert robotwin.check_vulkan({}, True).status is Status.FAILURE
    assert robotwin.check_vulkan({}, False).status is Status.WARNING


@pytest.mark.parametrize("real", [True, False])
def test_planners(monkeypatch, real):
    monkeypatch.setattr(robotwin, "has_curobo", lambda: real)
    monkeypatch.setattr(versions, "installed", lambda name: "0.2.1" if name == "mplib" else None)
    checks = by_name(robotwin.check_planners())
    assert checks["curobo"].status is (Status.OK if real else Status.WARNING)
    assert checks["mplib"].status is Status.WARNING
    assert "uninstall" in checks["mplib"].remedy
    monkeypatch.setattr(versions, "installed", lambda name: None)
    assert "mplib" not in by_name(robotwin.check_planners())
