"""The options every recovery env type has, what they ask for once checked, and the short names that
`roborecover eval` has for some and `lerobot-eval` does not."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.real_time import DURING_INFERENCE
from lerobot_roborecover.scenario import Start
from lerobot_roborecover.utils.options import move_old_fields, parse_shard

__all__ = ["GROUPS", "OptionError", "RecoveryOptions"]

GROUPS = ("suite", "cell", "source")
POLICY_WATCHDOG_S = 1800.0
"""Compiling a policy for the CPU takes minutes, and so does a batch of 64 for a large one."""

ALIASES = {
    "engine": "runner.engine",
    "videos": "runner.videos",
    "limit-seconds": "runner.limit_seconds",
    "sequential": "runner.sequential",
    "shard": "env.shard",
    "retry": "runner.retry",
}
"""Long name of each."""
JSON = {"json": "check.json=true"}
"""Of `roborecover check policy`: what the switch stands for."""
ALONE = "alone"
"""Value of `--runner.sequential` that compares with no other log."""


@dataclass
class RecoveryOptions:
    """Options of `--env.type=roborecover_*`, beside LeRobot's own of the platform."""

    scenarios: str = ""
    """Hub dataset id, folder, or the name of a shipped set; empty takes the platform's shipped set, and of
    it, where no split is named, what is for tests."""
    revision: str | None = None
    """Commit, tag or branch of a Hub dataset. Pin one: results name it."""
    split: str | None = None
    """Only scenarios of this split, e.g. `test`."""
    select: str = ""
    """Which scenarios, e.g. `suite=libero_goal|libero_10; cell=Approach-*; source=natural`."""
    start: str = "recovery"
    """Where the policy takes over: `recovery`, `initial` or `reversion`."""
    rewind_steps: int | None = None
    """Steps before the recovery point, for `start=reversion`, never before the task's start. Default: the
    paper's, 30, and on RoboTwin 60 for tasks with a horizon of 500 or more."""
    group_by: str = "suite"
    """How LeRobot groups its results: `suite`, `cell` or `source`."""
    shard: str = "0/1"
    """`k/n`: the k-th (from 0) of n parts; their union is everything and no two overlap."""
    trial_log: str = ""
    """File of finished trials (JSON lines); a rerun with the same file skips what is done. Default:
    `trials.jsonl` in the output directory, where one is given, else a new file under
    `outputs/roborecover/`."""
    strict_versions: bool = True
    """Refuse to score with simulator versions other than those that scores are defined on."""
    handoff_check: bool = True
    """Compare every handoff with the recorded one; beyond 2 mm the trial is a `state_mismatch`."""
    watchdog_s: float = 300.0
    """Longest a simulator may take over one command before its worker is replaced, seconds."""
    policy_watchdog_s: float = POLICY_WATCHDOG_S
    """Longest the policy may take over one inference before its trials end as `policy_error`, seconds; a
    first inference that compiles included. 0 waits for ever."""
    snapshot_dir: str = ""
    """Folder that keeps handoff snapshots between runs; empty shares them within the run alone."""
    record_actions: bool = False
    """Keep what was executed in every trial, in the folder `actions` beside the trial log: what forks and
    training data are made from."""
    videos: bool = False
    """Render frames for videos also where the observation has no pixels; `roborecover eval` then keeps four
    videos, as with pixels."""
    realtime: bool = False
    """The simulator runs on while the policy thinks: an inference costs control steps, which count."""
    latency_s: float | None = None
    """Seconds that an inference is taken to last, with `realtime`; None charges what each has taken."""
    during_inference: str = "hold"
    """What is executed during an inference, with `realtime`: `hold` repeats the last action, `chunk`
    goes on with the last chunk."""
    meanwhile: str | None = None
    """Earlier name of `during_inference`."""

    def __post_init__(self) -> None:
        move_old_fields(self, "--env.", {"meanwhile": "during_inference"})
        platforms_own = getattr(super(), "__post_init__", None)
        if platforms_own is not None:
            platforms_own()

    def check(self) -> None:
        """Checks what can be checked without scenarios.

        Raises:
            OptionError: naming the option, its value and what it may be.
        """
        if self.start not in list(Start):
            raise OptionError(f"--env.start={self.start}: not one of {[s.value for s in Start]}")
        if self.group_by not in GROUPS:
            raise OptionError(f"--env.group_by={self.group_by}: not one of {list(GROUPS)}")
        if self.rewind_steps is not None and not 0 <= self.rewind_steps <= 100_000:
            raise OptionError(f"--env.rewind_steps={self.rewind_steps}: a step count from 0 to 100000")
        if not 0 < self.watchdog_s < 86_400:
            raise OptionError(f"--env.watchdog_s={self.watchdog_s}: seconds, above 0 and below a day")
        if not 0 <= self.policy_watchdog_s < 86_400:
            raise OptionError(
                f"--env.policy_watchdog_s={self.policy_watchdog_s}: seconds below a day; 0 waits for ever"
            )
        if self.during_inference not in DURING_INFERENCE:
            raise OptionError(
                f"--env.during_inference={self.during_inference}: not one of {list(DURING_INFERENCE)}"
            )
        if self.latency_s is not None and not 0 <= self.latency_s <= 600:
            raise OptionError(f"--env.latency_s={self.latency_s}: seconds from 0 to 600")
        if not self.realtime and (self.latency_s is not None or self.during_inference != "hold"):
            raise OptionError(
                "--env.latency_s and --env.during_inference are charged with --env.realtime=true only"
            )
        self.shard_of()

    def shard_of(self) -> tuple[int, int]:
        """(k, n) of `shard`."""
        return parse_shard(self.shard, "--env.shard")

    def trial_log_path(self, output_dir: Path | None) -> Path:
        """Where the trials go.

        Args:
            output_dir: the run's output directory, where known.
        """
        if self.trial_log:
            return Path(self.trial_log).expanduser()
        if output_dir is not None:
            return output_dir / "trials.jsonl"
        return Path("outputs/roborecover") / time.strftime("%Y-%m-%d_%H-%M-%S") / "trials.jsonl"


def long_names(argv: Sequence[str], short: Mapping[str, str]) -> list[str]:
    """All arguments under their long names; `--sequential` without a log is given its value.

    Args:
        argv: arguments.
        short: long names.
    """
    found = [_long_name(argument, short) for argument in argv]
    for k, name in enumerate(found):
        if name == "--runner.sequential" and (k + 1 == len(found) or found[k + 1].startswith("--")):
            found[k] = f"{name}={ALONE}"
    return found


def _long_name(argument: str, short: Mapping[str, str]) -> str:
    """`--videos=3` as `--runner.videos=3`, and the like."""
    name, _, value = argument.removeprefix("--").partition("=")
    if not argument.startswith("--") or name not in short:
        return argument
    return f"--{short[name]}={value}" if value else f"--{short[name]}"
