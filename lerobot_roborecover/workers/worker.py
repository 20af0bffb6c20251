"""A simulator worker process: `python -m lerobot_roborecover.workers.worker FD [MEMORY_FD]`, commands in,
replies out. A `SlotServer` answers them: a simulator that lives for the whole run, and the recovery env of
the current trial on it.

Started as a fresh interpreter rather than through multiprocessing, whose spawn and forkserver methods import
the parent's main module again: under `lerobot-eval` that is LeRobot and torch, 15 s and 800 MB a worker.
"""

from __future__ import annotations

import os
import signal
import sys
import time
import traceback
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.replay.handoff import SnapshotCache
from lerobot_roborecover.scenario import TrialStart
from lerobot_roborecover.utils.signals import STOP_SIGNALS
from lerobot_roborecover.workers.messages import (
    ActResult,
    Channel,
    Command,
    EpisodeSpec,
    EpisodeStart,
    Server,
    SlotConfig,
    SlotFailure,
    video_stride,
)
from lerobot_roborecover.workers.parent import end_with_parent
from lerobot_roborecover.workers.recovery_env import RecoveryEnv


class SlotServer:
    """Answers the commands of one slot.

    Args:
        config: platform and simulator options.
    """

    def __init__(self, config: SlotConfig):
        self._config = config
        self._simulator = make_simulator(config.platform, **config.options)
        folder = Path(config.snapshot_dir) if config.snapshot_dir else None
        self._cache = SnapshotCache(folder=folder, approximate=config.approximate_snapshots)
        self._env: RecoveryEnv | None = None
        self._record_video, self._stepped = False, 0

    def answer(self, command: str, argument: Any = None) -> Any:
        """Runs one command: `spaces`, `reset`, `step`, `act`, `rollback`, `render`, `smoke`, `state` or
        `fingerprint`."""
        if command == "spaces":
            return {"observation_space": self._simulator.observation_space, "hz": self._simulator.control_hz}
        if command == "reset":
            return self._reset(argument)
        if command == "smoke":
            return self._smoke(argument)
        if command == "fingerprint":
            return self._simulator.fingerprint()
        assert self._env is not None, f"command {command!r} before reset"
        if command == "step":
            return self._act(argument[None], observe=True)
        if command == "act":
            return self._act(argument)
        if command == "rollback":
            result = self._env.rollback(argument)
            return replace(result, frame=self._env.render().copy()) if self._record_video else result
        if command == "render":
            return self._env.render()
        if command == "state":
            return self._simulator.state_sha256()
        raise ValueError(f"unknown slot command {command!r}")

    def _reset(self, spec: EpisodeSpec) -> EpisodeStart:
        self._env = RecoveryEnv(
            spec.scenario,
            spec.start,
            spec.rewind_steps,
            handoff_check=spec.handoff_check,
            simulator=self._simulator,
            cache=self._cache,
            control_mode=self._config.control_mode,
            rollback_steps=spec.rollback_steps,
            played=spec.played,
            spent=spec.spent,
        )
        observation, _ = self._env.reset()
        assert self._env.handoff is not None
        self._record_video, self._stepped = spec.record_video, 0
        frame = self._env.render() if spec.record_video else None
        hz = self._simulator.control_hz
        return EpisodeStart(observation, self._env.handoff, frame, hz, self._env.progress())

    def _smoke(self, scenario: TrialStart) -> np.ndarray | None:
        """A picture of the scenario's first state; None where that state cannot be had, which is a trial's
        own affair."""
        try:
            self._simulator.reset(scenario.task, scenario.reset)
        except Exception:
            return None
        return self._simulator.render()

    def _act(self, actions: np.ndarray, *, observe: bool = False) -> ActResult:
        """Executes (n, A) actions, up to success or the horizon; renders at the end alone, and only if it
        goes on, or with `observe`. A trial that records a video renders the steps of `video_stride`, and its
        last."""
        assert self._env is not None
        began = time.perf_counter()
        success = over = False
        steps = 0
        frames, progress, stride = [], [], video_stride(self._simulator.control_hz)
        for action in actions:
            success = self._env.advance(action)
            steps += 1
            self._stepped += 1
            over = success or self._env.out_of_steps
            if self._record_video and (over or self._stepped % stride == 0):
                frames.append(self._env.render().copy())
            if (done := self._env.progress()) is not None:
                progress.append(done)
            if over:
                break
        observation = self._simulator.observe() if observe or not over else None
        seconds = time.perf_counter() - began
        return ActResult(observation, steps, success, over, seconds, tuple(frames), progress=tuple(progress))

    def close(self) -> None:
        self._simulator.close()


def main(fd: int, memory: int | None = None) -> None:
    """Serves commands from the inherited socket until the parent closes it."""
    # The parent decides when to stop: a terminal, and many schedulers, signal the whole process group.
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    # A parent that is gone already, or that ends elsewhere than on Linux, shows as the socket's end; a worker
    # stuck in native code would not see that.
    end_with_parent(os.getppid())
    channel = Channel(Connection(fd), memory)
    server: Server | None = None
    failure = SlotFailure("raised", "the worker was not configured")
    while True:
        try:
            message: SlotConfig | Command = channel.receive()
        except EOFError:
            break
        try:
            if isinstance(message, SlotConfig):  # no reply; what goes wrong answers the commands that follow
                server = message.make_server()
                continue
            reply = server.answer(message.name, message.argument) if server is not None else failure
        except Exception as err:
            traceback.print_exc()
            reply = SlotFailure("raised", f"{type(err).__name__}: {err}")
            if server is None:
                failure = SlotFailure("raised", f"no simulator could be made: {reply.message}")
                continue
        try:
            channel.send(reply)
        except (BrokenPipeError, ConnectionResetError):
            break
    if server is not None:
        server.close()


if __name__ == "__main__":
    # The importable copy of this module, which `SlotConfig.server` names, so that each class exists once.
    from lerobot_roborecover.workers import worker

    worker.main(*map(int, sys.argv[1:]))
