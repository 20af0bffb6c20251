"""Work given to worker slots one command at a time, each slot busy as long as there is any."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lerobot_roborecover.workers.messages import InProgress, SlotFailure
from lerobot_roborecover.workers.slots import MAX_ATTEMPTS, SimulatorWorker

_POLL_S = 1.0

type Take[Item] = Callable[[Item | None, list[Item]], Item | None]
"""The next item for a slot, given the slot's last one and those under way; None where there is none now."""


@dataclass(eq=False)
class _Handed[Item]:
    """An item that a slot has, or had."""

    item: Item
    losses: int = 0
    """How often the machine that it was done on was lost."""


def map_unordered[Item](
    slots: Sequence[SimulatorWorker],
    command: str,
    take: Take[Item],
    argument: Callable[[Item], Any],
    *,
    fresh: bool = False,
) -> Iterator[tuple[Item, Any]]:
    """Yields items with their replies in order of arrival; a `SlotFailure` where the simulator failed.

    An item whose machine is lost is done again elsewhere, `MAX_ATTEMPTS` times in all. Closing the iterator
    ends the work under way.

    Args:
        slots: idle ones, all of one kind.
        command: to send.
        take: hands out the items.
        argument: what to send of one.
        fresh: a new process for each item.
    """
    last: dict[int, Item | None] = dict.fromkeys(range(len(slots)))
    busy: dict[int, _Handed[Item]] = {}
    waiting: deque[_Handed[Item]] = deque()

    def next_for(k: int) -> _Handed[Item] | None:
        if waiting:
            return waiting.popleft()
        item = take(last[k], [handed.item for handed in busy.values()])
        return None if item is None else _Handed(item)

    try:
        while True:
            idle = [k for k in range(len(slots)) if k not in busy]
            for k in idle:
                if not slots[k].starting and (handed := next_for(k)) is not None:
                    slots[k].send(command, argument(handed.item))
                    busy[k], last[k] = handed, handed.item
            idle = [k for k in idle if k not in busy]
            # Only an item at hand says that slots which are starting are still needed.
            if idle and all(slots[k].starting for k in idle) and (handed := next_for(idle[0])) is not None:
                waiting.appendleft(handed)
            starting = [k for k in idle if slots[k].starting and waiting]
            if not busy and not starting:
                return
            for k in _ready(slots, [*busy, *starting]):
                slot = slots[k]
                if k not in busy:
                    slot.poll_startup()
                    continue
                reply = slot.receive()
                if isinstance(reply, InProgress):
                    slot.send(command, None)
                    continue
                handed = busy.pop(k)
                if isinstance(reply, SlotFailure) and reply.kind == "lost":
                    handed.losses += 1
                    if handed.losses < MAX_ATTEMPTS:
                        waiting.append(handed)
                        continue
                    reply = replace(reply, message=f"lost {MAX_ATTEMPTS} times, last: {reply.message}")
                if fresh:
                    slot.end()
                yield handed.item, reply
    finally:
        for k in busy:
            slots[k].end()


def _ready(slots: Sequence[SimulatorWorker], parties: Sequence[int]) -> list[int]:
    """Which of the slots have something to say, once any has."""
    waited = [slots[k].ready for k in parties if slots[k].ready is not True]
    soon = min(slots[k].deadline for k in parties) - time.monotonic()
    waits = len(waited) == len(parties)
    ready = set(map(id, slots[0].wait(waited, max(min(_POLL_S, soon), 0.0)))) if waits else set()
    return [
        k
        for k in parties
        if slots[k].ready is True or id(slots[k].ready) in ready or time.monotonic() > slots[k].deadline
    ]


def map_ordered[Item](
    slots: Sequence[SimulatorWorker], command: str, items: Sequence[Item], argument: Callable[[Item], Any]
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
        for number, reply in map_unordered(slots, command, take, lambda number: argument(items[number])):
            waiting[number] = reply
            while given in waiting:
                yield waiting.pop(given)
                given += 1


def failed(reply: object) -> str:
    """What went wrong with a command, or nothing."""
    return reply.message if isinstance(reply, SlotFailure) else ""
