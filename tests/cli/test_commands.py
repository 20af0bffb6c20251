"""Every command is found and says what it takes: in this process, and nightly as a user starts it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_roborecover.cli.main import COMMANDS, _module, main

OURS = [name for name in COMMANDS if not hasattr(_module(name), "pass_through")]
"""Those whose arguments we parse; LeRobot parses the others'."""


@pytest.mark.parametrize("name", OURS)
def test_it_says_what_it_takes(name, capsys):
    with pytest.raises(SystemExit) as ended:
        main([name, "--help"])
    assert ended.value.code == 0
    said = capsys.readouterr()
    assert said.out.startswith(f"usage: roborecover {name} ")
    assert "".join(_module(name).HELP.split()) in "".join(said.out.split()), "whatever the width"
    assert said.err == ""


def test_all_commands_are_listed(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    listed = capsys.readouterr().out
    assert [name for name in COMMANDS if not re.search(rf"^    {name}\s", listed, re.M)] == []


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_the_installed_command_starts(name):
    program = Path(sys.executable).with_name("roborecover")
    done = subprocess.run([program, name, "--help"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--" in done.stdout
