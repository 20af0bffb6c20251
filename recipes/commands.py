"""The package's commands, as recipes call them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from lerobot_roborecover.workers.parent import ends_with_this


def program(*words: str | Path) -> None:
    """Runs a module of this environment, ended with the recipe whatever ends that: what it finished is kept,
    and the same recipe goes on there.

    Raises:
        subprocess.CalledProcessError: it failed; its own output says why.
    """
    subprocess.run([sys.executable, "-m", *map(str, words)], check=True, preexec_fn=ends_with_this())


def roborecover(*words: str | Path) -> None:
    """Runs one of the package's commands.

    Raises:
        subprocess.CalledProcessError: it failed; its own output says why.
    """
    program("lerobot_roborecover.cli.main", *words)


def evaluate(
    platform: str,
    scenarios: str | Path,
    split: str,
    out: Path,
    *options: str,
    trials: int = 1,
    start: str = "recovery",
    ids: Iterable[str] = (),
) -> Path:
    """Trials of a policy that reads the state, with what was executed; finished ones are kept.

    Args:
        platform: of the scenarios.
        scenarios: folder, Hub id or shipped name.
        split: of the set.
        out: folder of the log; runs from several starts may share it.
        options: of `roborecover eval`, the policy's among them.
        trials: of each scenario.
        start: `recovery` or `initial`.
        ids: of the scenarios; none takes the whole split.

    Returns:
        The trial log.
    """
    log, chosen = out / "trials.jsonl", list(ids)
    roborecover(
        "eval", "--env", f"roborecover_{platform}", f"--env.scenarios={scenarios}", f"--env.split={split}",
        "--env.obs_type=state", f"--env.start={start}", "--env.record_actions=true", f"--env.trial_log={log}",
        *([f"--env.select=id={'|'.join(chosen)}"] if chosen else []),
        *options, "--policy.device=cpu", f"--eval.n_episodes={trials}", f"--output_dir={out / 'eval'}",
    )  # fmt: skip
    return log
