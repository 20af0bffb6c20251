"""Work in a process of its own that says lines."""

from __future__ import annotations

import os
import signal
import time
from multiprocessing.connection import wait

import pytest

from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.web.background_server import BackgroundServer


def counts(upto, say):
    for number in range(upto):
        say(str(number))


def refuses(say):
    say("begins")
    raise ScenarioError("there is no such thing")


def dies(say):
    say("begins")
    os._exit(3)


def stays(say):
    try:  # from the first line on: who hears it may interrupt at once
        say(str(os.getpid()))
        time.sleep(60)
    except KeyboardInterrupt:
        say("finishes")
        raise


def runs(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_lines_come_in_order_and_then_the_end():
    with BackgroundServer("it", counts, 3) as speaker:
        assert wait([speaker], 60) == [speaker]
        assert [speaker.hear() for _ in range(4)] == ["0", "1", "2", None]


def test_an_error_of_the_work_is_raised_here():
    with BackgroundServer("it", refuses) as speaker:
        assert speaker.hear() == "begins"
        with pytest.raises(ScenarioError, match="there is no such thing"):
            speaker.hear()


def test_a_process_that_dies_is_an_error():
    with BackgroundServer("the server", dies) as speaker:
        assert speaker.hear() == "begins"
        with pytest.raises(ScenarioError, match="the server ended with status 3"):
            speaker.hear()


def test_what_says_nothing_in_time_is_an_error_and_is_ended():
    with BackgroundServer("the server", stays) as speaker:
        pid = int(speaker.hear() or 0)
        assert runs(pid)
        with pytest.raises(ScenarioError, match="the server did not start in time"):
            speaker.hear(time.monotonic() + 0.01)
    assert not runs(pid)


@pytest.mark.parametrize("here", [signal.default_int_handler, signal.SIG_IGN], ids=["front", "background"])
def test_an_interrupted_one_finishes_as_after_ctrl_c(here):
    before = signal.signal(signal.SIGINT, here)
    try:
        speaker = BackgroundServer("the server", stays)
    finally:
        signal.signal(signal.SIGINT, before)
    with speaker:
        assert speaker.hear()
        speaker.interrupt()
        assert speaker.hear() == "finishes"
        assert speaker.hear() is None
