"""Work given to slots that may be opening, and whose machines may be lost; the slots are stand-ins."""

from __future__ import annotations

from collections import Counter

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from lerobot_roborecover.workers.dispatch import map_ordered, map_unordered
from lerobot_roborecover.workers.messages import InProgress, SlotConfig, SlotFailure
from lerobot_roborecover.workers.slots import MAX_ATTEMPTS, SlotPool


class FragileSlot:
    """A slot that is lost when the fates say so, and opens again after some looks.

    Args:
        fates: how each command ends, one after the other over all slots; `done` once there are none left.
        given: counts how often each argument was sent.
        opening: looks that it takes to open.
    """

    deadline = float("inf")

    def __init__(self, fates, given, opening):
        self._fates, self._given, self._takes = fates, given, opening
        self._left = opening
        self._argument = None
        self.ended = 0

    starting = property(lambda self: self._left > 0)
    ready = property(lambda self: self)

    @staticmethod
    def wait(handles, _timeout_s):
        return handles[:1]

    def poll_startup(self):
        assert self.starting
        self._left -= 1

    def send(self, command, argument=None):
        assert not self.starting, "a slot that is not there was asked"
        assert command == "run"
        if argument is not None:
            self._given[argument] += 1
            self._argument = argument

    def receive(self):
        fate = next(self._fates, "done")
        if fate == "lost":
            self._left = self._takes
            return SlotFailure("lost", "the node is gone")
        return {"done": self._argument, "more": InProgress(), "died": SlotFailure("died", "it died")}[fate]

    def end(self):
        self.ended += 1


def slots_of(openings, fates, counts):
    fates = iter(fates)
    return [FragileSlot(fates, counts, opening) for opening in openings]


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    openings=st.lists(st.integers(0, 3), min_size=1, max_size=4),
    fates=st.lists(st.sampled_from(["done", "done", "lost", "died", "more"]), max_size=40),
    count=st.integers(0, 12),
)
def test_every_item_ends_once_and_is_lost_no_more_often_than_that(openings, fates, count):
    counts: Counter[int] = Counter()
    left = iter(range(count))
    found = list(
        map_unordered(
            slots_of(openings, fates, counts), "run", lambda *_: next(left, None), lambda item: item
        )
    )
    assert sorted(item for item, _ in found) == list(range(count))
    assert all(n <= MAX_ATTEMPTS for n in counts.values())
    for item, reply in found:
        if reply == item:
            continue
        assert isinstance(reply, SlotFailure)
        if reply.kind == "lost":
            assert counts[item] == MAX_ATTEMPTS
            assert reply.message == "lost 3 times, last: the node is gone"


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    openings=st.lists(st.integers(0, 3), min_size=1, max_size=4),
    losses=st.lists(st.booleans(), max_size=12),
    count=st.integers(0, 12),
)
@example(openings=[0, 0, 0, 1], losses=[True, True, True], count=5)
def test_the_order_stays_whatever_is_lost(openings, losses, count):
    fates = [fate for lost in losses for fate in (["lost", "done", "done"] if lost else ["done"])]
    given_out: Counter[int] = Counter()
    slots = slots_of(openings, fates, given_out)
    items = range(100, 100 + count)
    for item, reply in zip(items, map_ordered(slots, "run", items, lambda n: n), strict=True):
        if isinstance(reply, SlotFailure):  # one item may have drawn every loss
            assert (reply.kind, given_out[item]) == ("lost", MAX_ATTEMPTS)
        else:
            assert reply == item


def test_what_died_by_itself_is_not_tried_again():
    counts: Counter[int] = Counter()
    left = iter(range(3))
    (slot,) = slots_of([0], ["done", "died", "done"], counts)
    found = dict(map_unordered([slot], "run", lambda *_: next(left, None), lambda item: item, fresh=True))
    assert found == {0: 0, 1: SlotFailure("died", "it died"), 2: 2}
    assert set(counts.values()) == {1}
    assert slot.ended == 3, "a fresh process for each"


def test_slots_that_start_late_join_the_work():
    used = Counter()

    class Counted(FragileSlot):
        wait = staticmethod(lambda handles, _timeout_s: handles)

        def send(self, command, argument=None):
            used[self] += 1
            super().send(command, argument)

    slots = [Counted(iter(()), Counter(), opening) for opening in (0, 1)]
    left = iter(range(4))
    assert len(list(map_unordered(slots, "run", lambda *_: next(left, None), lambda item: item))) == 4
    assert len(used) == 2


def test_a_slot_that_finds_no_room_is_not_waited_for_while_others_are_idle():
    """Four were made, two machines' worth; one machine is gone, and what was on it has no room any more."""
    openings = iter([10**9, 0, 10**9, 0])
    pool = SlotPool(SlotConfig("fake", {}), workers=True, timeout_s=1.0)
    pool.make_with(lambda *_: FragileSlot(iter(()), Counter(), next(openings)))
    pool.slots(4)
    for count in (1, 2):
        slots = pool.worker_slots(count)
        assert not any(slot.starting for slot in slots)
        assert list(map_ordered(slots, "run", range(3), lambda item: item)) == [0, 1, 2]
    assert len(pool.worker_slots(4)) == 4
