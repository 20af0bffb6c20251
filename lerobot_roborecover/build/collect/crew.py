"""Work given to worker slots one command at a time, each slot busy as long as there is any."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import wait
from typing import Any

from lerobot_roborecover.build.collect.server import More
from lerobot_roborecover.env.episode import SlotFailure
from lerobot_roborecover.env.slots import WorkerSlot

_POLL_S = 1.0

type Take[Item] = Callable[[Item | None, list[Item]], Item | None]
"""The next item for a slot, given the slot's last one and those under way; None where there is none now."""


def each[Item](
    slots: Sequence[WorkerSlot], command: str, take: Take, argument: Callable[[Item], Any]
) -> Iterator[tuple[Item, Any]]:
    """Replies as they come, with what they are of; a `SlotFailure` where the simulator failed.

    Args:
        slots: idle ones.
        command: to send.
        take: hands out the items.
        argument: what to send of one.
    """
    last: dict[int, Item | None] = dict.fromkeys(range(len(slots)))
    busy: dict[int, Item] = {}
    while True:
        for k, slot in enumerate(slots):
            if k not in busy and (item := take(last[k], list(busy.values()))) is not None:
                slot.send(command, argument(item))
                busy[k] = last[k] = item
        if not busy:
            return
        waited = [slots[k].ready for k in busy if slots[k].ready is not True]
        ready = set(map(id, wait(waited, _POLL_S))) if len(waited) == len(busy) else set()
        for k in list(busy):
            slot = slots[k]
            if slot.ready is True or id(slot.ready) in ready or time.monotonic() > slot.deadline:
                reply = slot.receive()
                if isinstance(reply, More):
                    slot.send(command, None)
                else:
                    yield busy.pop(k), reply


def in_order[Item](
    slots: Sequence[WorkerSlot], command: str, items: Sequence[Item], argument: Callable[[Item], Any]
) -> Iterator[Any]:
    """Replies in the order of the items, with few of them ahead of the caller: they are large.

    Args:
        slots: idle ones.
        command: to send.
        items: what to do.
        argument: what to send of one.
    """
    handed = given = 0
    waiting: dict[int, Any] = {}

    def take(_last: int | None, busy: list[int]) -> int | None:
        nonlocal handed
        if handed == len(items) or handed - given > len(slots):
            return None
        handed += 1
        return handed - 1

    while given < len(items):
        for number, reply in each(slots, command, take, lambda number: argument(items[number])):
            waiting[number] = reply
            while given in waiting:
                yield waiting.pop(given)
                given += 1


def failed(reply: Any) -> str:
    """What went wrong with a command, or nothing."""
    return reply.message if isinstance(reply, SlotFailure) else ""
