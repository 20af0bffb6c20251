"""Python programs in processes of their own that do not pay for the same imports each time.

They are forked from one process that has imported what takes long and reads no settings; so each has an
environment, a working directory, arguments and module-level settings of its own, as if it were started anew.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

IMPORTED = (
    "lerobot_roborecover",  # before numpy: it pins how simulators round
    "pytest", "numpy", "pyarrow", "pyarrow.compute", "pyarrow.parquet", "pandas", "scipy.stats", "gymnasium",
    "httpx", "httpcore", "anyio", "yaml", "tqdm", "filelock", "jinja2", "PIL.Image", "PIL.ImageDraw",
    "lerobot_roborecover.cli.main", "lerobot_roborecover.datasets",
)  # fmt: skip
"""What every program finds imported. Not `huggingface_hub`, which reads its settings when it is imported."""


class Forked:
    """A program that runs; what `subprocess.Popen` has, as far as tests ask for it.

    Args:
        script: Python source.
        arguments: what it finds in `sys.argv` after its name.
        env: its whole environment.
        folder: its working directory.
        output: folder for what it prints.
    """

    def __init__(
        self, script: str, arguments: Sequence[str], env: Mapping[str, str], folder: Path, output: Path
    ):
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(list(IMPORTED))
        self.args = ["-c", *arguments]
        self._said = (output / "stdout", output / "stderr")
        self._process = context.Process(
            target=_run, args=(script, self.args, dict(env), str(folder), *map(str, self._said))
        )
        self._process.start()

    @property
    def returncode(self) -> int | None:
        """Exit status; None while it runs, minus a signal's number where one ended it."""
        return self._process.exitcode

    def kill(self) -> None:
        """Ends it with SIGKILL, if it still runs."""
        if self._process.is_alive():
            self._process.kill()

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Waits for its end, and returns what it printed and what it complained of."""
        self._process.join(timeout)
        if self._process.is_alive():
            raise subprocess.TimeoutExpired(self.args, timeout)
        out, err = (path.read_text() if path.exists() else "" for path in self._said)
        return out, err


def _run(script: str, argv: list[str], env: dict[str, str], folder: str, stdout: str, stderr: str) -> None:
    assert "huggingface_hub" not in sys.modules, "it would keep the settings of its importer"
    for descriptor, path in ((1, stdout), (2, stderr)):
        opened = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(opened, descriptor)
        os.close(opened)
    os.environ.clear()
    os.environ.update(env)
    os.chdir(folder)
    sys.argv = argv
    exec(compile(script, "<script>", "exec"), {"__name__": "__main__"})
