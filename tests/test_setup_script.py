"""`scripts/setup.sh`, with stand-ins for what it calls."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import PATIENCE_S

ROOT = Path(__file__).parents[1]

UV = """#!/usr/bin/env bash
set -e
case "$1" in
venv) mkdir -p .venv/bin; ln -sf "$PYTHON" .venv/bin/python ;;
pip)
    echo begin >>installs
    until [[ -e "$HERE/go" ]]; do sleep 0.05; done
    echo end >>installs
    ;;
esac
"""


@pytest.fixture
def clone(tmp_path):
    """A clone whose uv waits for `go` while it installs."""
    root = tmp_path / "clone"
    (root / "scripts").mkdir(parents=True)
    for name in ("scripts/setup.sh", "pyproject.toml", "constraints.txt", ".python-version"):
        shutil.copy(ROOT / name, root / name)
    programs = tmp_path / "programs"
    programs.mkdir()
    for path, text in (
        (root / "scripts" / "uv.sh", f"#!/usr/bin/env bash\necho {programs}/uv\n"),
        (root / "scripts" / "vulkan.sh", "#!/usr/bin/env bash\n"),
        (programs / "uv", UV),
        (programs / "dpkg-query", "#!/usr/bin/env bash\nprintf 'install ok installed'\n"),
    ):
        path.write_text(text)
        path.chmod(0o755)
    return root


def start(clone):
    here = clone.parent
    env = os.environ | {
        "PATH": f"{here / 'programs'}:{os.environ['PATH']}", "PYTHON": sys.executable, "HERE": str(here),
        "ROBORECOVER_SETUP_EVERY_S": "0.1",
    }  # fmt: skip
    return subprocess.Popen([clone / "scripts" / "setup.sh"], env=env, stderr=subprocess.PIPE, text=True)


@pytest.mark.skipif(shutil.which("flock") is None, reason="no flock: install util-linux")
def test_two_setups_in_one_clone_wait_for_each_other(clone):
    with start(clone) as first:
        for line in first.stderr:
            if "installing Python packages" in line:
                break
        with start(clone) as second:
            said = second.stderr.readline()
            assert "still installing Python packages" in first.stderr.readline()
            (clone.parent / "go").touch()
            assert "another setup is at work in this clone; waiting for it" in said
            assert second.wait(PATIENCE_S) == 0
        assert first.wait(PATIENCE_S) == 0
    assert (clone / "installs").read_text() == "begin\nend\n", "the second finds all in place"


@pytest.mark.skipif(shutil.which("flock") is None, reason="no flock: install util-linux")
def test_setup_goes_on_where_the_file_system_has_no_locks(clone):
    flock = clone.parent / "programs" / "flock"
    flock.write_text("#!/usr/bin/env bash\necho 'flock: 9: No locks available' >&2\nexit 71\n")
    flock.chmod(0o755)
    (clone.parent / "go").touch()
    with start(clone) as setup:
        assert setup.wait(PATIENCE_S) == 0
        assert "waiting" not in setup.stderr.read()
    assert (clone / "installs").read_text() == "begin\nend\n"


def test_help_and_unknown_options_install_nothing(clone):
    run = [clone / "scripts" / "setup.sh"]
    told = subprocess.run([*run, "--help"], capture_output=True, text=True)
    assert (told.returncode, told.stdout.startswith("usage: scripts/setup.sh")) == (0, True)
    assert "Sets up everything" in told.stdout
    refused = subprocess.run([*run, "--helo"], capture_output=True, text=True)
    assert (refused.returncode, refused.stderr) == (
        2,
        "setup: unknown option --helo: scripts/setup.sh --help\n",
    )
    assert not (clone / "installs").exists()
    assert not (clone / ".venv").exists()
