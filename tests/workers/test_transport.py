"""Messages between a slot and its worker: the same through shared memory as through the socket alone."""

from __future__ import annotations

import os
import pickle
import socket
import threading
from multiprocessing.connection import Connection

import numpy as np
import pytest

from lerobot_roborecover.workers import messages, slots
from lerobot_roborecover.workers.messages import MEMORY_BYTES, Channel, EpisodeSpec, SlotConfig, make_memory
from tests.support.factories import fake_scenario


@pytest.fixture(params=["memory", "pipes"])
def channels(request):
    """Both ends."""
    ours, theirs = (Connection(end.detach()) for end in socket.socketpair())
    memory = make_memory() if request.param == "memory" else None
    ends = Channel(ours, memory), Channel(theirs, memory)
    if memory is not None:
        os.close(memory)
    yield ends
    for end in ends:
        end.close()


def passed(channels, message):
    """The message as it arrives at the other end."""
    sender = threading.Thread(target=channels[0].send, args=(message,))
    sender.start()
    found = channels[1].receive()
    sender.join()
    return found


def pictures() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    plain = rng.integers(0, 256, (256, 256, 3), dtype=np.uint8)
    return {
        "plain": plain,
        "upside_down": plain[::-1],
        "every_other": plain[::2, ::2],
        "columns": np.asfortranarray(rng.standard_normal((100, 50))),
        "small": rng.standard_normal(8),
        "none": np.zeros((0, 3), np.float32),
        "names": np.array(["a", None], dtype=object),
        "same": plain,
    }


def test_what_arrives_is_what_was_sent_and_can_be_written_to(channels):
    sent = pictures()
    found = passed(channels, sent)
    expected = pickle.loads(pickle.dumps(sent))
    assert list(found) == list(expected)
    for name, value in expected.items():
        assert found[name].dtype == value.dtype
        assert found[name].shape == value.shape
        assert np.array_equal(found[name], value), name
        assert found[name].flags.writeable


def test_a_message_outlives_the_next_one(channels):
    first = passed(channels, {"a": np.full(100_000, 1.0)})
    assert passed(channels, {"a": np.full(100_000, 2.0)})["a"].max() == 2.0
    assert first["a"].max() == 1.0


def test_what_does_not_fit_goes_into_the_pickle(channels):
    large = np.arange(MEMORY_BYTES // 8 + 1, dtype=np.float64)
    found = passed(channels, [np.ones(5000), large, np.full(5000, 3.0)])
    assert np.array_equal(found[1], large)
    assert (found[0].max(), found[2].min()) == (1.0, 3.0)


def test_pictures_really_take_the_memory():
    ours, theirs = (Connection(end.detach()) for end in socket.socketpair())
    memory = make_memory()
    if memory is None:
        pytest.skip("this system has no memfd_create: everything goes through the socket")
    channel = Channel(ours, memory)
    os.close(memory)
    channel.send(pictures())
    data, sizes = theirs.recv()
    assert len(data) < 10_000
    # A picture that is there twice is sent once.
    assert sizes == [256 * 256 * 3, 256 * 256 * 3, 128 * 128 * 3, 100 * 50 * 8]
    channel.close()
    theirs.close()


@pytest.mark.parametrize("memory", [True, False])
def test_a_worker_gives_the_same_observations_either_way(memory, monkeypatch):
    if not memory:
        monkeypatch.setattr(slots, "make_memory", lambda: None)
    config = SlotConfig("fake", {"obs_type": "pixels_agent_pos", "observation_size": 96})
    spec = EpisodeSpec(fake_scenario(0), "recovery", 0, True)
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    found = []
    for slot in (slots.InlineSlot(config), slots.WorkerSlot(config, 120.0)):
        slot.send("reset", spec)
        replies = [slot.receive()]
        for _ in range(3):
            slot.send("act", actions)
            replies.append(slot.receive())
        slot.close()
        found.append([pickle.dumps(_plain(reply.observation)) for reply in replies])
    assert found[0] == found[1]
    assert b"pixels" in found[0][0]


@pytest.mark.slow
def test_a_worker_that_is_replaced_gets_memory_of_its_own():
    slot = slots.WorkerSlot(SlotConfig("fake", {"obs_type": "pixels_agent_pos"}), 120.0)
    spec = EpisodeSpec(fake_scenario(0), "recovery", 0, True)
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(2):
        slot.send("reset", spec)
        assert slot.receive().observation
        slot.end()
    slot.send("reset", spec)
    assert slot.receive().observation
    assert len(os.listdir("/proc/self/fd")) <= before
    slot.close()


def _plain(value):
    """Arrays as bytes, whatever they lie in."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    return (value.dtype.str, value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value


def test_a_system_without_such_memory_is_none_the_worse(monkeypatch):
    """Without `memfd_create` the socket is used."""
    monkeypatch.delattr(messages.os, "memfd_create", raising=False)
    assert make_memory() is None
