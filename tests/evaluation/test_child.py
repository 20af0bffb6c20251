"""Children of a study are stopped in good order, also those that other threads wait for."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from lerobot_roborecover.evaluation import arms
from lerobot_roborecover.workers import parent
from tests.support.processes import PATIENCE_S

WORKS = """
import sys, time
from pathlib import Path
from lerobot_roborecover.utils.signals import stop_signals_raise
with stop_signals_raise():
    try:
        Path(sys.argv[1], "began").touch()
        time.sleep(600)
    except KeyboardInterrupt:
        Path(sys.argv[1], "ended").touch()
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "works.py").write_text(WORKS)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(arms.__file__).parents[2]}")
    monkeypatch.setattr(parent, "_TOLD_S", 0.01)
    return "works"


def wait_for(path: Path) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not path.exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_an_interrupted_study_lets_its_children_put_things_in_order(module, tmp_path):
    done: list[int] = []
    command = [*arms.this_module(module), str(tmp_path)]
    thread = threading.Thread(target=lambda: done.append(arms.run_program(command, {})))
    thread.start()
    wait_for(tmp_path / "began")
    arms.stop_running()
    thread.join(PATIENCE_S)
    assert done == [0]
    assert (tmp_path / "ended").exists(), "the child had no time for its own end"


def test_an_interrupt_while_a_child_is_waited_for_stops_it(module, tmp_path, monkeypatch):
    from subprocess import Popen

    wait, interrupts = Popen.wait, [KeyboardInterrupt]

    def interrupted(self, timeout=None):
        if timeout is None and interrupts:
            wait_for(tmp_path / "began")
            raise interrupts.pop()
        return wait(self, timeout)

    monkeypatch.setattr(Popen, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        arms.run_program([*arms.this_module(module), str(tmp_path)], {})
    assert (tmp_path / "ended").exists()
