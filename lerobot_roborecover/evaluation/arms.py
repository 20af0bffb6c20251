"""An arm: one policy from one start, run in a process of its own until its log has every trial.

`demo`, `reproduce` and the studies of `recipes/` run their arms here, so in each of them a rerun goes on
where it was, an arm that has finished is not run again, and a failure shows the end of the output. Commands
run as processes of their own (`run_program`): no interpreter carries anything from one to the next. A log
that a command keeps for itself holds rows of one policy and setting (`claim_log`): others are moved out of
it.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot_roborecover.platforms.versions import row_versions
from lerobot_roborecover.policies.identity import content_hash, policy_identity
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.text import output_end
from lerobot_roborecover.workers.parent import ends_with_this, stop_children

DONE_FILE = "done.json"
"""Beside the log of an arm: the run that it was, and whether it has finished."""
_SHOWN_LINES = 12

IDENTITY_FILE = "identity.json"
"""Beside the log: whose rows it holds."""

DEFAULTS: Mapping[str, str] = {"MUJOCO_GL": "egl", "HF_HUB_OFFLINE": "1"}
"""Unless the caller's environment says otherwise."""
NESTED = "ROBORECOVER_NESTED"
"""Variable of a command that another command runs: the outer one says what comes next."""
_running: set[subprocess.Popen] = set()
_POLL_S = 0.5
CANNOT_START = "cannot start "
"""What `startable` begins a line with that names a run and says why it cannot be begun."""


@dataclass(frozen=True)
class Arm:
    """One run of `roborecover eval`, with a folder of its own."""

    name: str
    """What messages call it, e.g. `the initial arm`."""
    log: Path
    """Its trial log; what else is kept of it lies beside."""
    argv: Sequence[str]
    """Arguments of `roborecover`."""
    identity: Mapping[str, Any]
    """What all rows of the log must share, see `identity_of_run`."""
    decides: Any = None
    """What the run must share with a finished one, JSON-able; the arguments where it is None."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Variables that win over the caller's, such as those that decide how a policy rounds."""
    output: Path | None = None
    """File of what the run prints; None leaves it on the terminal."""

    def finished(self) -> bool:
        """Whether an earlier run of the same has finished."""
        record = self._record()
        return bool(record.get("finished")) and all(record.get(k) == v for k, v in self._key().items())

    def seconds(self) -> float:
        """Wall time of its runs so far, under the identity of today."""
        record = self._record()
        return float(record.get("seconds", 0.0)) if record.get("identity") == self._key()["identity"] else 0.0

    def run(self, say: Callable[[str], None], plan: str = "") -> None:
        """Runs what is not done yet.

        Args:
            say: takes progress lines.
            plan: said before it is begun.

        Raises:
            ScenarioError: it failed; the same command goes on with what is left.
        """
        claim_log(self.log, self.identity, say)
        if self.finished():
            return
        if plan:
            say(plan)
        before, began = self.seconds(), time.monotonic()
        self.log.parent.mkdir(parents=True, exist_ok=True)
        command = [*this_module("lerobot_roborecover.cli.main"), *self.argv]
        status = run_program(command, self.environment, self.output)
        seconds = before + time.monotonic() - began
        done = {**self._key(), "seconds": seconds, "finished": status == 0}
        atomic_write(self.log.with_name(DONE_FILE), json.dumps(done))
        if status:
            raise ScenarioError(
                failure(f"{self.name} (`{shlex.join(['roborecover', *self.argv])}`)", status, self.output)
            )

    def _key(self) -> dict[str, Any]:
        decides = list(self.argv) if self.decides is None else self.decides
        return json.loads(json.dumps({"argv": decides, "identity": self.identity}))

    def _record(self) -> dict[str, Any]:
        try:
            record = json.loads(self.log.with_name(DONE_FILE).read_text())
        except (OSError, ValueError):
            return {}
        return record if isinstance(record, dict) else {}


def failure(name: str, status: int, output: Path | None, done: str = "") -> str:
    """Says how a run ended that failed.

    Args:
        name: what was run.
        status: its exit status.
        output: file of what it printed; None where that is on the terminal.
        done: how far it came, e.g. ` after 3 of 8 trials`.
    """
    ended = f"{name} ended with status {status}{done}"
    if output is None:
        return f"{ended}; what it said is above. The same command goes on with what is left"
    cause, shown = output_end(output.read_text(errors="replace"), _SHOWN_LINES)
    return (
        f"{ended}: {cause or 'it said nothing'}\nThe end of {output}:\n{shown}\n"
        "Run the same command again to go on with what is left; 'roborecover doctor' checks this machine"
    )


def identity_of_run(platform: str, policy: Mapping[str, Any], **others: Any) -> dict[str, Any]:
    """Returns what all rows of a run's log must share.

    Args:
        platform: of its scenarios.
        policy: options of the policy, members as mappings; the content of a checkpoint or a mapping file
            takes the place of its path.
        others: whatever else decides the run's results, JSON-able.
    """
    versions = row_versions(platform) if platform else {}
    return json.loads(
        json.dumps({"policy": _by_content(policy), "versions": versions, **others}, default=str)
    )


def claim_log(log: Path, identity: Mapping[str, Any], say: Callable[[str], None] = print) -> None:
    """Makes a log the run's own: one with rows of another identity, or of an unknown one, is moved aside.

    Args:
        log: the trial log; need not exist.
        identity: of `identity_of_run`.
        say: takes the line that says what was moved.
    """
    beside = log.with_name(IDENTITY_FILE)
    text = json.dumps(identity, indent=1, sort_keys=True) + "\n"
    if beside.is_file() and beside.read_text(encoding="utf-8") == text:
        return
    if log.exists() and log.stat().st_size:
        there = next(path for path in _names(log) if not path.exists())
        os.replace(log, there)
        say(
            f"{log} holds trials of another policy or setting, or of an earlier version that does not say: "
            f"they are not reused, and are now in {there}"
        )
    atomic_write(beside, text)


def _names(log: Path) -> Iterator[Path]:
    number = 0
    while True:
        number += 1
        yield log.with_name(f"{log.name}.before-{number}")


def _by_content(policy: Mapping[str, Any]) -> dict[str, Any]:
    found = {}
    for name, value in policy.items():
        if isinstance(value, Mapping):
            found[name] = _by_content(value)
        elif name == "path" and value:
            found[name] = policy_identity(str(value), policy.get("revision"))
        elif isinstance(value, str) and value.endswith((".yaml", ".yml")) and Path(value).is_file():
            found[name] = content_hash(Path(value))
        else:
            found[name] = value
    return found


def this_module(module: str) -> list[str]:
    """Beginning of a command that runs a module of the project or of LeRobot."""
    return [sys.executable, "-m", module]


def run_program(
    command: Sequence[str],
    variables: Mapping[str, str],
    output: Path | None = None,
    watch: Callable[[], None] | None = None,
) -> int:
    """Runs a command that ends with its parent, in good order if possible.

    Args:
        command: program and arguments.
        variables: win over the environment, such as those that decide how a policy rounds.
        output: file that takes everything that it says, at its end; None leaves it on the terminal.
        watch: called twice a second while it runs.

    Returns:
        Its exit status.
    """
    with nullcontext(None) if output is None else output.open("ab") as stream:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL, stdout=stream, stderr=None if stream is None else subprocess.STDOUT,
            env={**DEFAULTS, **os.environ, **variables, NESTED: "1"}, preexec_fn=ends_with_this(),
        )  # fmt: skip
        _running.add(process)
        try:
            while True:
                try:
                    return process.wait(None if watch is None else _POLL_S)
                except subprocess.TimeoutExpired:
                    if watch is not None:
                        watch()
        except BaseException:
            stop_children([process])
            raise
        finally:
            _running.discard(process)


def stop_running() -> None:
    """Stops the children that other threads wait for."""
    stop_children(list(_running))
