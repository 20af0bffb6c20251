"""Work given to worker slots one command at a time, each slot busy as long as there is any."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import wait
from typing import Any

from lerobot_roborecover.workers.messages import More, SlotFailure
from lerobot_roborecover.workers.slots import WorkerSlot

_POLL_S = 1.0

type Take[Item] = Callable[[Item | None, list[Item]], Item | None]
"""The next item for a slot, given the slot's last one and those under way; None where there is none now."""


def each[Item](
    slots: Sequence[WorkerSlot],
    command: str,
    take: Take[Item],
    argument: Callable[[Item], Any],
    *,
    fresh: bool = False,
) -> Iterator[tuple[Item, Any]]:
    """Replies as they come, with what they are of; a `SlotFailure` where the simulator failed.

    Whoever stops asking ends what is under way.

    Args:
        slots: idle ones.
        command: to send.
        take: hands out the items.
        argument: what to send of one.
        fresh: a new process for each item.
    """
    last: dict[int, Item | None] = dict.fromkeys(range(len(slots)))
    busy: dict[int, Item] = {}
    try:
        while True:
            for k, slot in enumerate(slots):
                if k not in busy and (item := take(last[k], list(busy.values()))) is not None:
                    slot.send(command, argument(item))
                    busy[k] = last[k] = item
            if not busy:
                return
            waited = [slots[k].ready for k in busy if slots[k].ready is not True]
            soon = min(slots[k].deadline for k in busy) - time.monotonic()
            waits = len(waited) == len(busy)
            ready = set(map(id, wait(waited, max(min(_POLL_S, soon), 0.0)))) if waits else set()
            for k in list(busy):
                slot = slots[k]
                if slot.ready is True or id(slot.ready) in ready or time.monotonic() > slot.deadline:
                    reply = slot.receive()
                    if isinstance(reply, More):
                        slot.send(command, None)
                        continue
                    if fresh:
                        slot.end()
                    yield busy.pop(k), reply
    finally:
        for k in busy:
            slots[k].end()


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

    def take(_last: int | None, _busy: list[int]) -> int | None:
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


def failed(reply: object) -> str:
    """What went wrong with a command, or nothing."""
    return reply.message if isinstance(reply, SlotFailure) else ""
