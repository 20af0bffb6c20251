"""Runs the screening policies, and keeps their trials with the exact actions, one folder a policy.

`TRIALS/NAME/` holds the trial log, the actions, and in `policy.json` the options that they belong to. A rerun
goes on where it was interrupted; trials of other machines are taken over with `take_trials`.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.policy_trials import (
    CURRENT_FILE,
    TRIALS_FILE,
    env_config,
    read_trials,
    run_trials,
)
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.row import ACTIONS_FOLDER, LoggedTrial, actions_path
from lerobot_roborecover.logs.trial_log import TrialLog, check_retry
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_file, atomic_write
from lerobot_roborecover.workers.backend import LOCAL, Backend

POLICY_FILE = "policy.json"
RETRIED_FILE = "retried.jsonl"
SCHEMA_VERSION = 1
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True)
class PolicySpec:
    path: str
    """Folder or Hub id of the checkpoint."""
    name: str = ""
    """In tables and in the trials' folder; by default the checkpoint's own."""
    options: tuple[str, ...] = ()
    """`name=value` of the policy's config, e.g. `n_action_steps=10`."""
    env: tuple[str, ...] = ()
    """`name=value` of the recovery env type, beside those that hold for all policies."""
    rename_map: Mapping[str, str] = field(default_factory=dict)
    """The env's observation keys to the policy's."""

    def __post_init__(self):
        object.__setattr__(self, "name", self.name or default_name(self.path))
        if not _NAME.fullmatch(self.name):
            raise OptionError(
                f"policy name {self.name!r:.80} is not 1 to 64 letters, digits, '.', '_' or '-'; give "
                "another one: --policy NAME=PATH"
            )


def default_name(path: str) -> str:
    """A policy's name where none is given: its identity without the hash."""
    from lerobot_roborecover.policies.identity import policy_name

    return policy_name(path).strip("/").replace("/", "--")[:64]


def parse_policies(
    policies: Sequence[str],
    options: Sequence[str] = (),
    env: Sequence[str] = (),
    rename_maps: Sequence[str] = (),
) -> tuple[list[PolicySpec], list[str]]:
    """Parses policies from the command line.

    Args:
        policies: `PATH` or `NAME=PATH`.
        options: `key=value` for all, or `NAME:key=value` for one.
        env: the same, of the env type.
        rename_maps: JSON objects, or `NAME:{...}`.

    Returns:
        Policies, and the env options of all.

    Raises:
        OptionError: a name occurs twice, is not known, or an option is not one.
    """
    named = [_named(text) for text in policies]
    names = [name for name, _ in named]
    renames = {k: _rename_map(v) for k, v in _by_policy("--rename-map", rename_maps, names).items()}
    own, envs = _by_policy("--policy-option", options, names), _by_policy("--env", env, names)
    for label, given in (("--policy-option", own), ("--env", envs)):
        for text in (t for texts in given.values() for t in texts):
            if not re.match(r"[A-Za-z_][\w.]*=", text.removeprefix("--")):
                raise OptionError(f"{label} {text!r:.200}: write KEY=VALUE, or NAME:KEY=VALUE for one policy")
    clean = {k: [t.removeprefix("--") for t in texts] for k, texts in envs.items()}
    specs = [
        PolicySpec(
            path, name, tuple(t.removeprefix("--") for t in (*own.get("", ()), *own.get(name, ()))),
            tuple(clean.get(name, ())), {**renames.get("", {}), **renames.get(name, {})},
        )
        for name, path in named
    ]  # fmt: skip
    return specs, clean.get("", [])


def _named(text: str) -> tuple[str, str]:
    name, sep, path = text.partition("=")
    if sep and path and _NAME.fullmatch(name) and not Path(text).exists():
        return name, path
    return default_name(text), text


def _by_policy(label: str, texts: Iterable[str], names: Sequence[str]) -> dict[str, list[str]]:
    """Texts by the policy's name before the colon; those for all under the empty name."""
    found: dict[str, list[str]] = {}
    for text in texts:
        name, sep, rest = text.partition(":")
        if sep and name in names:
            found.setdefault(name, []).append(rest)
        elif sep and _NAME.fullmatch(name) and "=" not in name:
            raise OptionError(f"{label} {text!r:.200}: no policy is named {name!r}; there are {list(names)}")
        else:
            found.setdefault("", []).append(text)
    return found


def _rename_map(texts: Sequence[str]) -> dict[str, str]:
    merged: dict[str, str] = {}
    for text in texts:
        try:
            given = json.loads(text)
        except ValueError as err:
            raise OptionError(f"--rename-map {text!r:.200} is not JSON ({err})") from None
        if not isinstance(given, dict) or not all(isinstance(v, str) for v in given.values()):
            raise OptionError(f"--rename-map {text!r:.200}: write an object of observation keys")
        merged |= given
    return merged


def check_policies(policies: Sequence[PolicySpec]) -> None:
    """Checks that policies can be distinguished.

    Raises:
        OptionError: there is none, a name occurs twice, or two are the same.
    """
    if not policies:
        raise OptionError("no policy: name the screening policies with --policy (the paper has four)")
    for key, what in (
        (lambda p: p.name, "have the name"),
        (
            lambda p: (p.path, sorted(p.options), sorted(p.env), sorted(p.rename_map.items())),
            "are the same checkpoint and options:",
        ),
    ):
        seen: dict[Any, PolicySpec] = {}
        for policy in policies:
            other = seen.setdefault(str(key(policy)), policy)
            if other is not policy:
                raise OptionError(
                    f"two policies {what} {policy.name!r} ({other.path}, {policy.path}); their trials would "
                    "be counted twice. Leave one out, or name them: --policy NAME=PATH"
                )


def run_policy(
    policy: PolicySpec,
    scenarios: str,
    platform: str,
    folder: Path,
    *,
    trials: int,
    only: Collection[str] | None = None,
    run_seed: int = 1000,
    env: Sequence[str] = (),
    shard: str = "",
    device: str | None = None,
    slots: int = 0,
    max_batch: int = 1,
    workplace: Backend = LOCAL,
    replicas: int = 0,
    snapshots: Path | None = None,
    on_row: Callable[[Any, int, int], None] = lambda row, done, total: None,
) -> list[LoggedTrial]:
    """Runs the trials missing from the policy's folder, and returns all trials.

    Args:
        policy: who.
        scenarios: shipped name, folder or Hub id of the set.
        platform: of the set.
        folder: of all policies' trials.
        trials: per scenario.
        only: ids of scenarios; None takes all.
        run_seed: of the run.
        env: `name=value` options of the env type.
        shard: `k/n`, or empty for everything.
        device: of the policy.
        slots, max_batch, workplace, replicas: of `run_trials`.
        snapshots: folder of handoffs that other runs have left, where the options name none.
        on_row: called with each finished trial, and how many are done of how many.

    Raises:
        OptionError: the folder holds trials of this name with other options.
    """
    mine = folder / policy.name
    claim_folder(policy, mine, env)
    given = [*env, *policy.env, *([f"shard={shard}"] if shard else [])]
    config = env_config(platform, scenarios, [f"--{option}" for option in given])
    config.snapshot_dir = config.snapshot_dir or str(snapshots or "")
    return run_trials(
        policy.path, config, mine, trials=trials, only=only, seed=run_seed, device=device, slots=slots,
        max_batch=max_batch, workplace=workplace, replicas=replicas,
        policy_options=[f"--{o}" for o in policy.options],
        rename_map=policy.rename_map, on_row=on_row,
    )  # fmt: skip


def claim_folder(policy: PolicySpec, folder: Path, env: Sequence[str] = ()) -> None:
    """Notes whose trials a folder holds; trial rows do not tell options of a policy's config.

    Raises:
        OptionError: they are of other options.
    """
    document = {"schema_version": SCHEMA_VERSION, **asdict(policy), "env": [*env, *policy.env]}
    document = json.loads(json.dumps(document))
    path = folder / POLICY_FILE
    if path.exists():
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as err:
            raise OptionError(f"{path} cannot be read ({err}); restore it, or remove {folder}") from None
        # The path may have moved: rows name the checkpoint by its content.
        for key in ("options", "rename_map", "env"):
            if before.get(key) != document[key]:
                raise OptionError(
                    f"{folder} holds trials with {key} {before.get(key)}, not {document[key]}. Give the "
                    "policy another name (--policy NAME=PATH), or name another --trials-folder"
                )
        return
    atomic_write(path, json.dumps(document, indent=1) + "\n")


def take_trials(source: Path, target: Path) -> int:
    """Takes over one policy's trials from another folder, e.g. of another machine's shard.

    Args:
        source: of the policy, as `run_policy` leaves it.
        target: the same here.

    Returns:
        The number of trials that were new.

    Raises:
        OptionError: they are of other options.
        ScenarioError: a trial ended otherwise here than there.
    """
    theirs = source / POLICY_FILE
    target.mkdir(parents=True, exist_ok=True)
    if (source / CURRENT_FILE).exists() and not (target / CURRENT_FILE).exists():
        shutil.copyfile(source / CURRENT_FILE, target / CURRENT_FILE)
    if theirs.exists() and not (target / POLICY_FILE).exists():
        shutil.copyfile(theirs, target / POLICY_FILE)
    elif theirs.exists():
        ours, other = (json.loads((f / POLICY_FILE).read_text()) for f in (target, source))
        if any(ours.get(k) != other.get(k) for k in ("options", "rename_map", "env")):
            raise OptionError(
                f"{source} and {target} hold trials of other options; see {POLICY_FILE} in each"
            )
    new = 0
    log = TrialLog(target / TRIALS_FILE)
    try:
        for trial in read_trials(source):
            row, before = trial.row, log.find(trial.row.key())
            if before is not None and (before.success, before.steps) != (row.success, row.steps):
                raise ScenarioError(
                    f"trial {row.trial} of {row.scenario_id} by {row.policy} has ended otherwise in {source} "
                    f"than in {target}; keep the folders apart"
                )
            if before is not None:
                continue
            if row.steps:
                with atomic_file(actions_path(target / ACTIONS_FOLDER, row)) as copy:
                    shutil.copyfile(actions_path(source / ACTIONS_FOLDER, row), copy)
            log.append(row)
            new += 1
    finally:
        log.close()
    return new


def forget_trials(folder: Path, outcomes: Sequence[str]) -> int:
    """Takes trials of invalid outcomes out of a policy's log, so that they run again; they stay in
    `retried.jsonl`.

    Raises:
        OptionError: an outcome is unknown or valid.
    """
    chosen, path = check_retry(outcomes), folder / TRIALS_FILE
    if not path.exists():
        return 0
    with closing(TrialLog(path)) as log:
        return log.set_aside(chosen, folder / RETRIED_FILE)
