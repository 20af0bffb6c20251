"""Simulators draw on the policy's GPU, whatever order EGL counts in."""

from __future__ import annotations

import pytest

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.workers.messages import SlotConfig
from lerobot_roborecover.workers.render_device import (
    EglDevice,
    egl_devices,
    node_environment,
    query_devices,
    render_environment,
    visible_gpu,
)
from lerobot_roborecover.workers.slots import WorkerSlot

DEVICES = [EglDevice(0, 1, False), EglDevice(1, 0, False), EglDevice(2, None, True)]
"""Two GPUs that EGL counts the other way round, and Mesa."""


def chosen(choice: str, policy: str = "cuda", devices=DEVICES, **environment: str) -> str | None:
    return render_environment(choice, policy, devices, environment).get("MUJOCO_EGL_DEVICE_ID")


def test_the_policys_gpu_is_drawn_on():
    assert chosen("auto", "cuda") == "1"
    assert chosen("auto", "cuda:1") == "0"
    assert chosen("auto", "cuda:0", CUDA_VISIBLE_DEVICES="1,0") == "0"
    assert chosen("auto", "cuda:1", CUDA_VISIBLE_DEVICES="1,0") == "1"


def test_robosuite_cannot_object():
    assert render_environment("auto", "cuda", DEVICES, {})["CUDA_VISIBLE_DEVICES"] is None


def test_auto_leaves_the_users_own_choice_and_cpu_policies_alone():
    assert chosen("auto", "cpu") is None
    assert chosen("auto", "cuda", MUJOCO_EGL_DEVICE_ID="0") is None
    assert render_environment("auto", "cuda", DEVICES, {"MUJOCO_GL": "osmesa"}) == {}
    assert chosen("auto", "cuda", CUDA_VISIBLE_DEVICES="GPU-8a1b") is None


def test_software_rendering_by_choice():
    assert chosen("cpu") == "2"
    assert render_environment("cpu", "cuda", DEVICES[:2], {}) == {"MUJOCO_GL": "osmesa"}


def test_a_gpu_by_number():
    assert chosen("1", "cpu") == "0"
    with pytest.raises(OptionError, match=r"render_device=5.*GPUs \[0, 1\].*render_device=cpu"):
        chosen("5")
    with pytest.raises(OptionError, match="auto, cpu, or a GPU"):
        chosen("gpu")


def test_torchs_numbers_become_the_machines():
    assert visible_gpu("cuda:1", {"CUDA_VISIBLE_DEVICES": "4,6"}) == 6
    assert visible_gpu("cuda", {}) == 0
    assert visible_gpu("cuda:2", {"CUDA_VISIBLE_DEVICES": "4,6"}) is None
    assert visible_gpu("cpu", {}) is None


def test_on_a_cluster_simulators_take_their_machines_gpus_in_turn():
    def index(choice, turn, devices=DEVICES, **environment):
        return node_environment(choice, turn, devices, environment).get("MUJOCO_EGL_DEVICE_ID")

    assert [index("auto", turn) for turn in range(3)] == ["1", "0", "1"]
    assert index("auto", 1, CUDA_VISIBLE_DEVICES="") == "0", "Ray hides GPUs from those that ask for none"
    assert index("auto", 0, CUDA_VISIBLE_DEVICES="1") == "1"
    assert index("auto", 0, DEVICES[2:]) is None
    assert index("auto", 0, MUJOCO_EGL_DEVICE_ID="0") is None
    assert index("cpu", 0) == "2"
    assert index("1", 0) == "0"
    with pytest.raises(OptionError, match=r"render_device=5.*GPUs \[0, 1\]"):
        index("5", 0)


@pytest.mark.render
def test_this_machines_devices_are_listed():
    try:
        here = query_devices()
    except OSError as err:
        pytest.skip(f"no EGL device list ({err}): apt-get install libegl1 libegl-mesa0")
    assert egl_devices() == here
    assert [d.index for d in here] == list(range(len(here)))
    assert not any(d.software and d.cuda is not None for d in here)


def test_a_worker_gets_its_slots_environment(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    config = SlotConfig("fake", environment={"MUJOCO_EGL_DEVICE_ID": "7", "CUDA_VISIBLE_DEVICES": None})
    slot = WorkerSlot(config, 30.0)
    try:
        slot.send("fingerprint")
        slot.receive()
        with open(f"/proc/{slot.pid}/environ", "rb") as file:
            variables = file.read().split(b"\0")
    finally:
        slot.close()
    assert b"MUJOCO_EGL_DEVICE_ID=7" in variables
    assert not [v for v in variables if v.startswith(b"CUDA_VISIBLE_DEVICES")]
