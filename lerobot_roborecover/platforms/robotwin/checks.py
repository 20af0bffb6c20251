"""Checks of what RoboTwin needs beside packages: its checkout, its assets, Vulkan, and curobo."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from lerobot_roborecover.platforms import versions
from lerobot_roborecover.platforms.findings import Check, Status
from lerobot_roborecover.platforms.robot_fingerprint import compare_robots
from lerobot_roborecover.platforms.robotwin.checkout import RobotwinCheckout
from lerobot_roborecover.platforms.robotwin.robot import another_robot
from lerobot_roborecover.platforms.robotwin.stubs import has_curobo
from lerobot_roborecover.platforms.simulator import SimulatorError

_SHOWN_TASKS = 5


def check_checkout(required: bool, recorded: Mapping[str, str]) -> list[Check]:
    """The checkout that ROBOTWIN_ROOT names, its robot and its object models.

    Args:
        required: what is missing is a failure rather than a warning.
        recorded: what recorded the shipped set, its robot among it (`Fingerprint.versions`).
    """
    status = Status.FAILURE if required else Status.WARNING
    try:
        checkout = RobotwinCheckout()
    except SimulatorError as err:
        return [Check("RoboTwin checkout", status, "none is usable", str(err))]
    commit = checkout.commit[:12] or "not a git clone, so no commit is known"
    found = f"{checkout.root} ({commit}; configurations in {checkout.configs.relative_to(checkout.root)})"
    checks = [Check("RoboTwin checkout", Status.OK, found)]
    checks.append(check_robot(checkout, status, recorded))
    lacking = {task: checkout.missing_objects(task) for task in checkout.step_limits}
    blocked = sorted(task for task, missing in lacking.items() if missing)
    name = "RoboTwin objects"
    if not blocked:
        checks.append(Check(name, Status.OK, f"there for all {len(lacking)} tasks"))
        return checks
    runnable = len(lacking) - len(blocked)
    shown = ", ".join(blocked[:_SHOWN_TASKS]) + (", …" if len(blocked) > _SHOWN_TASKS else "")
    detail = f"{runnable} of {len(lacking)} tasks can run; these lack object models: {shown}"
    checks.append(Check(name, Status.WARNING, detail, checkout.download_command("objects")))
    return checks


def check_robot(checkout: RobotwinCheckout, status: Status, recorded: Mapping[str, str]) -> Check:
    """Whether the checkout's robot is there, is the paper's, and is the one that recorded the shipped set.

    Args:
        checkout: whose robot.
        status: of a robot that is missing or another.
        recorded: what recorded the shipped set.
    """
    name = "RoboTwin robot"
    try:
        robot = checkout.robot
        released = robot.from_released_mm()
        here = robot.fingerprint
    except SimulatorError as err:
        return Check(name, status, "missing, or not usable", str(err))
    compared = compare_robots(recorded, here)
    wrong = [another_robot(released)] if another_robot(released) else []
    wrong += [f"of the shipped set's robot, {'; '.join(compared.elsewhere)}"] if compared.another else []
    worst = max(released.values())
    detail = f"{checkout.embodiment}: wrists {worst:.4f} mm from where the paper's release has them"
    if wrong:
        remedy = (
            "scenarios of the paper and of the shipped set do not replay on it. Put RoboTwin's own robot in "
            f"its place: {checkout.download_command('embodiments')}"
        )
        return Check(
            name, status, f"{checkout.embodiment} is another than the paper's: {'; '.join(wrong)}", remedy
        )
    if not compared.known:
        return Check(name, Status.OK, f"{detail}; the shipped set has no robot to compare with")
    if compared.shapes:
        shown = f"{detail}; its arms reach where the shipped set's do, but {'; '.join(compared.shapes)}"
        return Check(name, Status.WARNING, shown, "the check of every handoff decides whether that matters")
    return Check(name, Status.OK, f"{detail}; the robot of the shipped set")


def check_vulkan(probe: Mapping[str, Any], required: bool) -> Check:
    """Whether SAPIEN renders.

    Args:
        probe: answers of `probe_vulkan`.
        required: a missing device is a failure rather than a warning.
    """
    name = "Vulkan (SAPIEN)"
    icd = os.environ.get("VK_ICD_FILENAMES") or os.environ.get("VK_DRIVER_FILES") or "the system's drivers"
    if versions.installed("sapien") is None:
        status = Status.FAILURE if required else Status.WARNING
        return Check(name, status, "sapien is not installed", versions.install_command("robotwin"))
    if probe.get("correct"):
        return Check(name, Status.OK, f"renders on {probe.get('device')} through {icd}")
    why = probe.get("error", "the test picture is wrong")
    remedy = (
        "NVIDIA: install the driver's Vulkan part (libvulkan1, nvidia_icd.json). CPU: Mesa 25 or later; "
        'export VK_ICD_FILENAMES="$(scripts/vulkan.sh)" gets it on Debian 12; and '
        "--env.render_quality=trivial. Without Vulkan --env.obs_type=state still works"
    )
    return Check(name, Status.WARNING, f"no picture through {icd}: {why}", remedy)


def check_planners() -> list[Check]:
    """curobo, which end-effector actions need, and mplib, which is not used here."""
    checks = []
    if has_curobo():
        checks.append(Check("curobo", Status.OK, "installed: joint and end-effector actions"))
    else:
        remedy = "only --env.action_mode=ee needs it: RoboTwin's installation guide, an NVIDIA GPU"
        checks.append(Check("curobo", Status.WARNING, "not installed: joint actions only", remedy))
    mplib = versions.installed("mplib")
    if mplib is not None:
        detail = f"{mplib} is installed and not used: it crashes beside numpy 2, and toppra does its part"
        checks.append(Check("mplib", Status.WARNING, detail, "pip uninstall -y mplib"))
    return checks
