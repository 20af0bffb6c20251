"""How messages travel between a slot and its worker: pickles through a socket, pictures beside them in memory
that both have mapped.

A picture in a pickle is copied into the pickle, into the socket and out of it piece by piece, for which both
processes wait, and out of the pickle. Through shared memory it is copied twice
(`benchmarks/observed_steps.py`). The memory is a file without a name (`memfd_create`): it is gone with its
last user whatever ends that, and a container's `/dev/shm` does not limit it. Where the system has none, or a
reply does not fit, everything goes into the pickle. What arrives is the same, bit for bit.
"""

from __future__ import annotations

import io
import mmap
import os
import pickle
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

MEMORY_BYTES = 1 << 26
"""Of a slot's memory; pages that were never written take none."""
_SMALL_BYTES = 1 << 13
"""What is smaller travels in the pickle."""
_ALIGNED = 64


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
