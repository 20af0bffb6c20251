"""Commands that recipes call."""

import signal
import subprocess
import sys

import pytest

from tests.support.processes import alive_after

RECIPE = "from recipes.commands import program; program('tests.recipes.says_who_it_is')"


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's order is Linux's")
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_a_command_ends_with_its_recipe(how):
    recipe = subprocess.Popen([sys.executable, "-c", RECIPE], stdout=subprocess.PIPE, text=True)
    assert recipe.stdout is not None
    command = recipe.stdout.readline().strip()
    recipe.send_signal(how)
    assert recipe.wait() == -how
    assert not alive_after({command}, seconds=60)
