"""Where processes are to be, as options say it: what is refused before anything starts. Needs no Ray."""

from __future__ import annotations

import importlib.util

import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.utils.text import install_command
from lerobot_roborecover.workers.backend import LOCAL, Backend
from lerobot_roborecover.workers.slots import SlotPool, WorkerSlot
from tests.support.shipped_policies import CHECKPOINT

COMMANDS = {
    "collect": ["--env.type=roborecover_fake", "--task=toy", "--expert=expert", "--seeds=0", "--out=OUT"],
    "screen": ["OUT", f"--policy={CHECKPOINT}", "--out=OUT"],
    "validate": ["OUT", "--trials-folder=OUT", "--out=OUT"],
}


@pytest.fixture
def nothing_starts(monkeypatch):
    monkeypatch.setattr(WorkerSlot, "_start", lambda *_: pytest.fail("a simulator was started"))
    monkeypatch.setattr(SlotPool, "slots", lambda *_: pytest.fail("a slot was asked for"))


@pytest.mark.lerobot
@pytest.mark.parametrize("command", COMMANDS)
def test_another_engine_or_no_ray_is_refused_before_anything_starts(
    command, nothing_starts, monkeypatch, tmp_path, capsys
):
    words = [word.replace("OUT", str(tmp_path / "out")) for word in COMMANDS[command]]
    assert main([command, *words, "--engine=foo"]) == 2
    assert "--engine=foo: not one of ['local', 'ray']" in capsys.readouterr().err
    there = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "ray" else there(name, *a)
    )
    assert main([command, *words, "--engine=ray"]) == 2
    assert f"Ray is not installed. {install_command('ray')}, on every node" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_options_are_named_as_the_command_has_them():
    assert Backend("ray").option("ray_address") == "--ray-address"
    assert Backend("ray", prefix="--runner.").option("ray_address") == "--runner.ray_address"
    with pytest.raises(OptionError, match=r"^--runner\.engine=rya: not one of"):
        Backend("rya", prefix="--runner.").check()
    LOCAL.check()


def test_on_this_machine_nothing_is_joined():
    class Untouched:
        def __getattr__(self, name):
            raise AssertionError(f"{name} of a pool that stays here")

    assert LOCAL.allocate_workers(Untouched(), 0, 3) == 3
    assert LOCAL.allocate_workers(Untouched(), 5, 3) == 5
