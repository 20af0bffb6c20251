"""The real `huggingface_hub` client, in processes of its own, against the stand-in of the Hub.

The client reads its settings when it is imported; so each command runs in a process with its own (`Forked`).
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

from tests.support.forked import Forked
from tests.support.hub_server import TOKEN, HubServer
from tests.support.processes import PATIENCE_S

REPO = "lab/recovery"

CLI = """
import sys
from lerobot_roborecover.datasets import retries
retries.FIRST_WAIT_S = 0.01
import huggingface_hub.utils._http as http
http.time.sleep = lambda s: None
from lerobot_roborecover.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
"""`roborecover`, without the waits between attempts."""


class HubClient:
    """Runs Python with a Hub cache below a folder, and this server as its Hub.

    Args:
        hub: the server.
        folder: working directory, and where the cache goes.
        output: folder for what the processes print.
    """

    def __init__(self, hub: HubServer, folder: Path, output: Path):
        self._hub, self._folder, self._output = hub, folder, output

    def start(
        self, script: str, *args: object, token: str = "", endpoint: str = "", offline: bool = False
    ) -> Forked:
        """Starts a script."""
        env = {k: v for k, v in os.environ.items() if not k.startswith(("HF_", "HUGGING"))}
        env |= {
            "HF_ENDPOINT": endpoint or self._hub.endpoint,
            "HF_HOME": str(self._folder / "hf"),
            "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "HF_HUB_DISABLE_PROGRESS_BARS": "1",
            "NO_PROXY": "127.0.0.1",
            "PYTHONPATH": str(Path(__file__).parents[2]),
        }
        env |= {"HF_TOKEN": token} if token else {}
        env |= {"HF_HUB_OFFLINE": "1"} if offline else {}
        said = Path(tempfile.mkdtemp(prefix="said-", dir=self._output))
        return Forked(script, [*map(str, args)], env, self._folder, said)

    def run(self, script: str, *args: object, **settings) -> subprocess.CompletedProcess:
        """Runs a script to its end."""
        process = self.start(script, *args, **settings)
        try:
            out, err = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)

    def roborecover(self, *args: object, **settings) -> subprocess.CompletedProcess:
        """Runs the command line, logged in unless an option says otherwise."""
        return self.run(CLI, *args, **{"token": TOKEN, **settings})

    def publish(self, root: Path, *args: object, status: int = 0, **settings) -> subprocess.CompletedProcess:
        """Publishes a folder, and checks the exit status."""
        arguments = ["publish", root, "--repo-id", REPO, "--license", "cc-by-4.0", *args]
        done = self.roborecover(*arguments, **settings)
        assert done.returncode == status, done.stderr + done.stdout
        return done


def commit_of(done: subprocess.CompletedProcess) -> str:
    """The commit that a publication printed."""
    return next(line.split()[1] for line in done.stdout.splitlines() if line.startswith("commit"))
