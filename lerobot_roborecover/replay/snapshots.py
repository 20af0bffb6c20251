"""Snapshots of simulators before the last step of a handoff, so that a later trial can start from one."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from lerobot_roborecover.scenario import Rollout
from lerobot_roborecover.utils.atomic_io import atomic_write


class SnapshotCache:
    """Handoff snapshots by key, the least recently used dropped; optionally kept on disk as well.

    Args:
        max_bytes: memory the snapshots may take.
        folder: where to keep them between runs; None keeps them in memory alone.
        approximate: also serve simulators whose snapshots are not exact: the state is restored, but the
            steps after it drift from a replay. Off by default.
    """

    def __init__(self, max_bytes: int = 64 * 2**20, folder: Path | None = None, *, approximate: bool = False):
        self.approximate = approximate
        self._max_bytes = max_bytes
        self._folder = folder
        self._entries: OrderedDict[str, tuple[bytes, str]] = OrderedDict()
        self._bytes = 0
        self.rejected: set[str] = set()
        """Keys whose restored state once differed from a replay's: never used again."""

    def get(self, key: str) -> tuple[bytes, str] | None:
        """The snapshot and the state hash that one step after it must give, or None."""
        if key in self.rejected:
            return None
        if key in self._entries:
            self._entries.move_to_end(key)
            return self._entries[key]
        if self._folder is not None:
            try:
                raw = (self._folder / f"{key}.snapshot").read_bytes()
            except OSError:
                return None
            digest, body = raw[:32], raw[32:]
            if hashlib.sha256(body).digest() != digest:
                return None
            entry = (body[64:], body[:64].decode())
            self._remember(key, entry)
            return entry
        return None

    def put(self, key: str, snapshot: bytes, state_sha256: str) -> None:
        """Keeps a snapshot together with the state hash it leads to."""
        self._remember(key, (snapshot, state_sha256))
        if self._folder is not None:
            body = state_sha256.encode() + snapshot
            # A full disk costs a replay later; it is not to cost the trial.
            with suppress(OSError):
                atomic_write(self._folder / f"{key}.snapshot", hashlib.sha256(body).digest() + body)

    def reject(self, key: str) -> None:
        """Drops a snapshot that did not lead to the replayed state, for good."""
        self.rejected.add(key)
        entry = self._entries.pop(key, None)
        if entry:
            self._bytes -= len(entry[0])
        if self._folder is not None:
            (self._folder / f"{key}.snapshot").unlink(missing_ok=True)

    def _remember(self, key: str, entry: tuple[bytes, str]) -> None:
        if key in self._entries:
            self._bytes -= len(self._entries.pop(key)[0])
        self._entries[key] = entry
        self._bytes += len(entry[0])
        while self._bytes > self._max_bytes and len(self._entries) > 1:
            self._bytes -= len(self._entries.popitem(last=False)[1][0])


def snapshot_key(rollout: Rollout, step: int, versions: Mapping[str, str]) -> str:
    """Cache key of a handoff: what is replayed, handoff step, and the versions that decide the physics."""
    text = f"{rollout.sha256()} {step} {sorted(versions.items())}"
    return hashlib.sha256(text.encode()).hexdigest()
