"""Runs `lerobot-eval` in a process of its own, as a user would, and watches its trial log."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from lerobot_roborecover.demo import DemoError
from lerobot_roborecover.demo.settings import DemoSettings
from lerobot_roborecover.evaluation.progress import LogTail, ProgressLine, RunProgress
from lerobot_roborecover.utils.determinism import policy_kernels
from lerobot_roborecover.utils.text import output_end
from lerobot_roborecover.workers.parent import ends_with_this, stop_children

_POLL_S = 0.5
_SHOWN_LINES = 12


def eval_command(settings: DemoSettings, platform: str, ids: Sequence[str], start: str) -> list[str]:
    """The command line of one start.

    Args:
        settings: the demo.
        platform: the scenarios' platform.
        ids: scenarios to run.
        start: `recovery` or `initial`.
    """
    program = list(settings.program) or [_lerobot_eval()]
    return [
        *program,
        "--env",
        f"roborecover_{platform}",
        f"--env.scenarios={settings.scenarios}",
        f"--env.select=id={'|'.join(ids)}",
        f"--env.obs_type={settings.obs_type}",
        f"--env.start={start}",
        f"--env.trial_log={settings.trial_log}",
        f"--policy.path={settings.policy}",
        f"--eval.n_episodes={settings.trials}",
        f"--eval.batch_size={settings.trials}",
        f"--output_dir={settings.out / start}",
    ]


def _lerobot_eval() -> str:
    beside = Path(sys.executable).with_name("lerobot-eval")
    found = str(beside) if beside.is_file() else shutil.which("lerobot-eval")
    if found is None:
        raise DemoError(f"no lerobot-eval beside {sys.executable} nor on PATH. pip install 'lerobot>=0.6.1'")
    return found


def evaluate(settings: DemoSettings, platform: str, ids: Sequence[str], start: str) -> None:
    """Runs one start to its end; trials that the log already holds are not repeated.

    Args:
        settings: the demo.
        platform: the scenarios' platform.
        ids: scenarios to run.
        start: `recovery` or `initial`.

    Raises:
        DemoError: `lerobot-eval` failed, or left trials out; the message shows the end of its output.
    """
    tail, tally = LogTail(settings.trial_log), RunProgress(start, ids, settings.trials)
    progress = ProgressLine(start)
    tally.add(tail.read())
    folder = settings.out / start
    if tally.done == tally.total and (folder / "eval_info.json").is_file():
        progress.show(tally, final=True)
        return
    folder.mkdir(parents=True, exist_ok=True)
    output = folder / "lerobot-eval.log"
    # The kernels win over the environment: the table is to be the same on every machine that has them.
    environment = {"MUJOCO_GL": "egl", **os.environ, **policy_kernels()}
    if Path(settings.policy).is_dir():
        # Nothing is needed from the Hub, and a machine without network should not wait for it.
        environment.setdefault("HF_HUB_OFFLINE", "1")
    with open(output, "wb") as stream:
        process = subprocess.Popen(
            eval_command(settings, platform, ids, start),
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=environment,
            # A demo that is killed must not leave a run behind that holds the trial log.
            preexec_fn=ends_with_this(),
        )
        try:
            while process.poll() is None:
                progress.show(tally)
                time.sleep(_POLL_S)
                tally.add(tail.read())
        finally:
            stop_children([process])
    tally.add(tail.read())
    progress.show(tally, final=True)
    if process.returncode != 0 or tally.done < tally.total:
        cause, shown = output_end(output.read_text(errors="replace"), _SHOWN_LINES)
        raise DemoError(
            f"lerobot-eval from {start} starts ended with status {process.returncode} after {tally.done} of "
            f"{tally.total} trials: {cause or 'it said nothing'}\nThe end of {output}:\n{shown}\n"
            "Run the same command again to go on with what is left; 'roborecover doctor' checks this machine"
        )
