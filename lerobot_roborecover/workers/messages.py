"""Messages between the parent and a slot: plain data that is sent to a worker process.

The parent sends a `SlotConfig` first, then `Command`s; the slot replies once to each of these.

Messages travel as pickles through a socket, pictures beside them in memory that both processes have mapped
(`Channel`). A picture in a pickle is copied into the pickle, into the socket and out of it piece by piece,
for which both processes wait, and out of the pickle. Through shared memory it is copied twice
(`benchmarks/observed_steps.py`). The memory is a file without a name (`memfd_create`): it is gone with its
last user whatever ends that, and a container's `/dev/shm` does not limit it. Where the system has none, or a
reply does not fit, everything goes into the pickle. What arrives is the same, bit for bit.
"""

from __future__ import annotations

import importlib
import io
import mmap
import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any, Protocol

import numpy as np

from lerobot_roborecover.replay.handoff import Handoff
from lerobot_roborecover.replay.rollback import RollbackResult
from lerobot_roborecover.scenario import TrialStart

MEMORY_BYTES = 1 << 26
"""Of a slot's memory; pages that were never written take none."""
_SMALL_BYTES = 1 << 13
"""What is smaller travels in the pickle."""
_ALIGNED = 64


@dataclass(frozen=True)
class SlotConfig:
    """How a slot makes its simulator; one slot serves one platform."""

    platform: str
    options: dict[str, Any] = field(default_factory=dict)
    """Keyword options of the simulator."""
    snapshot_dir: str | None = None
    """Folder of handoff snapshots shared by the slots of a run; None keeps them in each slot's memory."""
    approximate_snapshots: bool = False
    """Use snapshots also where what follows them drifts from a replay."""
    control_mode: str | None = None
    """How actions after the handoff are read, for simulators that have more than one way."""
    environment: Mapping[str, str | None] = field(default_factory=dict)
    """Environment variables of a worker process, beside the caller's; None unsets one."""
    server: str = "lerobot_roborecover.workers.worker:SlotServer"
    """`module:class` that answers the slot's commands, made with this configuration."""
    settings: dict[str, Any] = field(default_factory=dict)
    """What a server other than the usual one wants to know; plain JSON values."""
    start_s: float | None = None
    """What a fresh worker may take to import its simulator, beside the watchdog's limit for its first
    command; None for the usual."""

    def make_server(self) -> Server:
        module, _, name = self.server.partition(":")
        return getattr(importlib.import_module(module), name)(self)


class Server(Protocol):
    """What lives in a worker and answers its commands."""

    def answer(self, command: str, argument: Any = None) -> Any:
        """Runs one command; its reply."""

    def close(self) -> None:
        """Ends the simulator."""


@dataclass(frozen=True)
class Command:
    """A request to a slot, which replies once; with a `SlotFailure` where the request fails."""

    name: str
    argument: object = None


@dataclass(frozen=True)
class InProgress:
    """Reply before the result: the command is running; send it again without an argument to continue."""


def video_stride(hz: float) -> int:
    """Steps from one frame of a video to the next: 20 frames a second, and not 80 of Meta-World.

    Args:
        hz: control steps a second.
    """
    return max(1, round(hz / 20))


@dataclass(frozen=True)
class EpisodeSpec:
    """One trial's start."""

    scenario: TrialStart
    start: str
    rewind_steps: int
    handoff_check: bool
    record_video: bool = False
    """Whether replies to `reset` and `act` bring frames for a video, see `video_stride`."""
    rollback_steps: int = 0
    """Most steps of a rollback: snapshots of as many steps are kept, where they are exact."""
    played: np.ndarray | None = None
    """(n, A) actions of a fork's parent, in their own type: executed after the handoff and before the first
    observation."""
    spent: int = 0
    """New steps that count as taken when the policy takes over."""


@dataclass(frozen=True)
class EpisodeStart:
    """Reply to a reset."""

    observation: dict[str, Any]
    handoff: Handoff
    frame: np.ndarray | None = None
    """(H, W, 3) uint8, upright; where the trial records a video."""
    hz: float = 0.0
    """Control steps per simulated second."""
    progress: float | None = None
    """Progress of the task, from 0 to 1; None where the simulator does not tell."""


@dataclass(frozen=True)
class ActResult:
    """Reply to `act`: several actions were executed without observations in between. To `step`: one was."""

    observation: dict[str, Any] | None
    """After the last action. None after an `act` once the trial is over, when it is not needed."""
    steps: int
    """Actions executed: all, or those up to success or the horizon."""
    success: bool
    over: bool
    """The trial has succeeded or run out of steps."""
    seconds: float
    """Wall time of the simulator, observation included."""
    frames: tuple[np.ndarray, ...] = ()
    """(H, W, 3) uint8 after each step, where the trial records a video."""
    attachment: bytes = b""
    """What the slot's server has made of a trial that is over, for the parent to keep: in a collection the
    rollout's record."""
    progress: tuple[float, ...] = ()
    """After each step; empty where the simulator does not tell."""


@dataclass(frozen=True)
class RollbackReply(RollbackResult):
    """Reply to `rollback`: how it went, and what is seen there."""

    observation: dict[str, Any]
    seconds: float
    """Wall time, observation included."""
    solved: bool
    """Whether the task's predicate holds there already, which leaves nothing to recover from."""
    frame: np.ndarray | None = None
    """(H, W, 3) uint8, where the trial records a video."""
    progress: float | None = None
    """As in `EpisodeStart`."""


@dataclass(frozen=True)
class SlotFailure:
    """Reply in place of a result: the simulator raised, its process died, or it did not answer in time."""

    kind: str
    """`raised`, `died`, `hung`, or `lost` where the slot is gone together with its machine."""
    message: str


type Reply = EpisodeStart | ActResult | RollbackReply | SlotFailure | np.ndarray | dict | None


def make_memory() -> int | None:
    """A descriptor of new shared memory, which the caller closes; None where the system has none."""
    if not hasattr(os, "memfd_create"):
        return None
    descriptor = os.memfd_create("roborecover-slot")
    os.ftruncate(descriptor, MEMORY_BYTES)
    return descriptor


class Channel:
    """One end. A message with large arrays is read before the next one is sent, in either direction, so one
    piece of memory is enough.

    Args:
        connection: to the other end.
        memory: descriptor of memory that both ends have; None without. It is mapped, and can be closed.
    """

    def __init__(self, connection: Connection, memory: int | None = None):
        self.connection = connection
        self._memory = None if memory is None else mmap.mmap(memory, MEMORY_BYTES)

    def send(self, message: Any) -> None:
        """Sends a message; large arrays through the memory."""
        sizes: list[int] = []
        end = 0

        def apart(buffer: pickle.PickleBuffer) -> bool:
            """Whether the pickle is to hold it after all."""
            nonlocal end
            raw = buffer.raw()
            memory = self._memory
            if memory is None or raw.nbytes < _SMALL_BYTES or end + raw.nbytes > MEMORY_BYTES:
                return True
            memory[end : end + raw.nbytes] = raw
            sizes.append(raw.nbytes)
            end = _after(end, raw.nbytes)
            return False

        stream = io.BytesIO()
        _Pickler(stream, 5, buffer_callback=apart).dump(message)
        self.connection.send((stream.getvalue(), sizes))

    def receive(self) -> Any:
        """The next message, with arrays of its own.

        Raises:
            EOFError: the other end is closed.
        """
        data, sizes = self.connection.recv()
        buffers, start = [], 0
        for size in sizes:
            assert self._memory is not None
            # A bytearray, so that arrays can be written to, as those of a pickle can.
            buffers.append(bytearray(memoryview(self._memory)[start : start + size]))
            start = _after(start, size)
        return pickle.loads(data, buffers=buffers)

    def close(self) -> None:
        """Closes the connection and gives the memory back."""
        self.connection.close()
        if self._memory is not None:
            self._memory.close()
            self._memory = None


class _Pickler(pickle.Pickler):
    """Pickles pictures that are views, such as those turned upside down, as their contents in order: only
    those can travel apart."""

    def reducer_override(self, obj: Any) -> Any:
        if type(obj) is np.ndarray and obj.dtype != object and not obj.flags.forc:
            return np.ascontiguousarray(obj).__reduce_ex__(5)
        return NotImplemented


def _after(start: int, size: int) -> int:
    """Where the next array begins."""
    return -(-(start + size) // _ALIGNED) * _ALIGNED
