"""A simulator worker process: `python -m lerobot_roborecover.workers.worker FD [MEMORY_FD]`, commands in,
replies out.

Started as a fresh interpreter rather than through multiprocessing, whose spawn and forkserver methods import
the parent's main module again: under `lerobot-eval` that is LeRobot and torch, 15 s and 800 MB a worker.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
from multiprocessing.connection import Connection

from lerobot_roborecover.utils.signals import STOP_SIGNALS
from lerobot_roborecover.workers.messages import Command, Server, SlotConfig, SlotFailure
from lerobot_roborecover.workers.parent import end_with_parent
from lerobot_roborecover.workers.transport import Channel


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
    main(*map(int, sys.argv[1:]))
