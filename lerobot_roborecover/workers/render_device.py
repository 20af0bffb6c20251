"""Which graphics device simulators draw on: the policy's GPU, another one, or none.

MuJoCo counts EGL devices in its own order (`MUJOCO_EGL_DEVICE_ID`), which need not be CUDA's. The driver says
which EGL device is which CUDA device (EGL_NV_device_cuda), and which is Mesa's software renderer.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from lerobot_roborecover.errors import OptionError

if TYPE_CHECKING:
    from _ctypes import _CData

_EGL_EXTENSIONS = 0x3055
_EGL_CUDA_DEVICE_NV = 0x323A
_PROBE_S = 60.0


@dataclass(frozen=True)
class EglDevice:
    """One entry of EGL's device list."""

    index: int
    """What `MUJOCO_EGL_DEVICE_ID` means by it."""
    cuda: int | None
    """CUDA's number of it, counted over all GPUs of the machine; None where it is no CUDA device."""
    software: bool
    """Mesa's renderer on the CPU."""


def query_devices() -> list[EglDevice]:
    """EGL's device list. Loads the driver, which belongs into a process of its own: see `egl_devices`.

    Raises:
        OSError: there is no EGL library, or it cannot list devices.
    """
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]

    def function(name: str, result: type[_CData], *arguments: type[_CData]):
        address = egl.eglGetProcAddress(name.encode())
        if not address:
            raise OSError(f"this EGL library has no {name}")
        return ctypes.CFUNCTYPE(result, *arguments)(address)

    number, pointer = ctypes.c_int(), ctypes.c_void_p
    query = function("eglQueryDevicesEXT", ctypes.c_uint, ctypes.c_int, pointer, ctypes.POINTER(ctypes.c_int))
    text = function("eglQueryDeviceStringEXT", ctypes.c_char_p, pointer, ctypes.c_int)
    attribute = function(
        "eglQueryDeviceAttribEXT", ctypes.c_uint, pointer, ctypes.c_int, ctypes.POINTER(ctypes.c_ssize_t)
    )
    query(0, None, ctypes.byref(number))
    devices = (pointer * number.value)()
    query(number.value, devices, ctypes.byref(number))
    found = []
    for index, device in enumerate(devices):
        extensions = (text(device, _EGL_EXTENSIONS) or b"").split()
        ordinal = ctypes.c_ssize_t()
        is_cuda = b"EGL_NV_device_cuda" in extensions
        is_cuda = is_cuda and attribute(device, _EGL_CUDA_DEVICE_NV, ctypes.byref(ordinal))
        software = b"EGL_MESA_device_software" in extensions
        found.append(EglDevice(index, ordinal.value if is_cuda else None, software))
    return found


def egl_devices() -> list[EglDevice]:
    """EGL's device list, asked for in a process of its own; empty where there is none."""
    # Under CUDA_VISIBLE_DEVICES a driver may leave devices out or count anew.
    environment = {k: v for k, v in os.environ.items() if k != "CUDA_VISIBLE_DEVICES"}
    environment["PYTHONPATH"] = os.pathsep.join(p for p in sys.path if p)
    try:
        result = subprocess.run(
            [sys.executable, "-m", __name__], capture_output=True, text=True, timeout=_PROBE_S,
            env=environment, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return []
    if result.returncode != 0:
        return []
    return [EglDevice(**d) for d in json.loads(result.stdout)]


def visible_gpu(device: str, environment: Mapping[str, str] = os.environ) -> int | None:
    """The machine's number of the GPU that torch calls `device`; None where it is no GPU or not known.

    Args:
        device: e.g. `cuda`, `cuda:1`, `cpu`.
        environment: for `CUDA_VISIBLE_DEVICES`.
    """
    match = re.fullmatch(r"cuda(?::(\d+))?", device)
    if not match:
        return None
    ordinal = int(match[1] or 0)
    visible = environment.get("CUDA_VISIBLE_DEVICES", "")
    if not visible:
        return ordinal
    names = [name.strip() for name in visible.split(",")]
    return int(names[ordinal]) if ordinal < len(names) and names[ordinal].isdigit() else None


def render_environment(
    choice: str, policy_device: str, devices: Sequence[EglDevice], environment: Mapping[str, str] = os.environ
) -> dict[str, str | None]:
    """Environment variables that make a worker draw on the chosen device.

    Args:
        choice: `auto` (the policy's GPU), `cpu`, or a GPU as torch counts.
        policy_device: e.g. `cuda:1` or `cpu`.
        devices: EGL's.
        environment: the caller's own; an EGL device or a `MUJOCO_GL` other than EGL that is set there stays
            under `auto`.

    Returns:
        Variables to set; None unsets one.

    Raises:
        OptionError: there is no such device.
    """
    backend = environment.get("MUJOCO_GL", "egl").lower()
    if choice == "auto":
        gpu = visible_gpu(policy_device, environment)
        match = next((d for d in devices if gpu is not None and d.cuda == gpu), None)
        if match is None or backend != "egl" or "MUJOCO_EGL_DEVICE_ID" in environment:
            return {}
    elif choice == "cpu":
        match = next((d for d in devices if d.software), None)
        if match is None or backend == "osmesa":
            return {"MUJOCO_GL": "osmesa"}
    elif choice.isdigit():
        gpu = visible_gpu(f"cuda:{choice}", environment)
        match = next((d for d in devices if gpu is not None and d.cuda == gpu), None)
        if match is None:
            there = sorted(d.cuda for d in devices if d.cuda is not None)
            raise OptionError(
                f"--runner.render_device={choice}: EGL offers no such GPU; it offers GPUs {there} of "
                "this machine. Install the driver's EGL library, or use --runner.render_device=cpu"
            )
    else:
        raise OptionError(f"--runner.render_device={choice}: must be auto, cpu, or a GPU's number")
    # robosuite refuses an EGL device whose number CUDA_VISIBLE_DEVICES does not list (robosuite 1.4,
    # utils/binding_utils.py), although the two are counted differently; a simulator needs no CUDA.
    return {
        "MUJOCO_GL": "egl",
        "MUJOCO_EGL_DEVICE_ID": str(match.index),
        "CUDA_VISIBLE_DEVICES": None,
    }


def node_environment(
    choice: str, turn: int, devices: Sequence[EglDevice], environment: Mapping[str, str] = os.environ
) -> dict[str, str | None]:
    """The same for a simulator on a machine of its own, where the policy need not be.

    Args:
        choice: `auto` (the machine's GPUs, in turn), `cpu`, or a GPU as the machine counts.
        turn: the simulator's number.
        devices: EGL's, on that machine.
        environment: the caller's own, see `render_environment`.

    Raises:
        OptionError: there is no such device.
    """
    # What a scheduler hides from CUDA, because a simulator asks for no GPU, EGL still draws on.
    environment = {k: v for k, v in environment.items() if k != "CUDA_VISIBLE_DEVICES"}
    gpus = sorted(d.cuda for d in devices if d.cuda is not None)
    device = f"cuda:{gpus[turn % len(gpus)]}" if gpus else "cpu"
    return render_environment(choice, device, devices, environment)


def node_drawing(choice: str, turn: int) -> dict[str, str | None]:
    """`node_environment` of the machine where this is called."""
    return node_environment(choice, turn, egl_devices())


if __name__ == "__main__":
    print(json.dumps([asdict(d) for d in query_devices()]))
