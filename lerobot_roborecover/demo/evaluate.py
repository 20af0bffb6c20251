"""Runs `lerobot-eval` in a process of its own, as a user would, and watches its trial log."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from lerobot_roborecover.demo import DemoError
from lerobot_roborecover.demo.settings import DemoSettings
from lerobot_roborecover.evaluation.arms import failure, run_program
from lerobot_roborecover.evaluation.progress import LogTail, ProgressLine, RunProgress
from lerobot_roborecover.utils.determinism import policy_kernels


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
    tail, count = LogTail(settings.trial_log), RunProgress(start, ids, settings.trials)
    progress = ProgressLine(start)
    count.add(tail.read())
    folder = settings.out / start
    if count.done == count.total and (folder / "eval_info.json").is_file():
        progress.show(count, final=True)
        return
    folder.mkdir(parents=True, exist_ok=True)
    output = folder / "lerobot-eval.log"
    output.unlink(missing_ok=True)
    # The kernels win over the environment: the table is to be the same on every machine that has them.
    variables = dict(policy_kernels())
    if not Path(settings.policy).is_dir():  # it is on the Hub
        variables["HF_HUB_OFFLINE"] = os.environ.get("HF_HUB_OFFLINE", "0")

    def watch() -> None:
        count.add(tail.read())
        progress.show(count)

    status = run_program(eval_command(settings, platform, ids, start), variables, output, watch)
    watch()
    progress.show(count, final=True)
    if status != 0 or count.done < count.total:
        done = f" after {count.done} of {count.total} trials"
        raise DemoError(failure(f"lerobot-eval from {start} starts", status, output, done))
