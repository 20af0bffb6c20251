"""Every option of every command, as a table: `tests/cli/options.json`.

`python -m tests.support.option_table` writes it anew.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import json
from pathlib import Path
from typing import Any

from lerobot_roborecover.cli.arguments import OldName
from lerobot_roborecover.cli.main import build_parser, command_parser
from lerobot_roborecover.cli.tree import GROUPS, SPLIT_NAMES, find_call
from recipes.study import __main__ as study

FILE = Path(__file__).parents[1] / "cli" / "options.json"

type Options = dict[str, dict[str, Any]]
"""By name (`--slots`, or `dataset` where its place says it): what is said of it."""


def our_options() -> dict[str, Options]:
    """By command: options that our own parsers read."""
    found: dict[str, Options] = {}
    for name, parser in _parsers_of(build_parser()).items():
        inner = {f"{name} {word}": p for word, p in _parsers_of(parser).items()} if name in GROUPS else {}
        found |= {name: _of_parser(p) for name, p in (inner or {name: parser}).items()}
    found["study"] = _of_parser(study.build_parser())
    for name in SPLIT_NAMES:
        call = find_call([name])
        assert call is not None
        found[name] = _of_parser(command_parser(call))
    return {name: options for name, options in found.items() if options}


def _parsers_of(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return dict(commands.choices)


def lerobots_options() -> dict[str, Options]:
    """By command, or by what is chosen: options of ours that LeRobot's parser reads, not LeRobot's own."""
    from lerobot_roborecover.evaluation.check_policy import CheckOptions
    from lerobot_roborecover.evaluation.env_configs import ENV_TYPES
    from lerobot_roborecover.evaluation.options import ALIASES, JSON, RecoveryOptions
    from lerobot_roborecover.evaluation.runner import RunnerOptions
    from lerobot_roborecover.platforms.registry import ENV_PREFIX
    from lerobot_roborecover.policies import ema
    from lerobot_roborecover.policies.detectors.monitor import (
        configuration_roborecover_monitor,
        configuration_roborecover_monitor_small,
    )
    from lerobot_roborecover.policies.interventions.configuration_intervention import (
        RoboRecoverInterventionConfig,
    )
    from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig
    from lerobot_roborecover.policies.remote.serve import ServeConfig
    from lerobot_roborecover.robot.commands import CaptureConfig, PlanRunConfig, RestoreConfig

    short = {f"--{name}": {"stands_for": f"--{long}"} for name, long in ALIASES.items()}
    check = {f"--{name}": {"stands_for": f"--{long}"} for name, long in JSON.items()}
    return {
        "eval": _of_class(RunnerOptions, "--runner.") | _of_class(RecoveryOptions, "--env.") | short,
        "check policy": _of_class(CheckOptions, "--check.") | check,
        "serve": _of_class(ServeConfig, "--"),
        "robot capture": _of_class(CaptureConfig, "--"),
        "robot restore": _of_class(RestoreConfig, "--"),
        "robot run": _of_class(PlanRunConfig, "--"),
        **{
            f"--env.type={ENV_PREFIX}{name}": _of_class(ENV_TYPES[name], "--env.", RecoveryOptions)
            for name in ("fake", "lerobot", "libero", "metaworld", "robotwin")
        },
        "--policy.type=roborecover_remote": _of_class(RemoteConfig, "--policy."),
        "--policy.type=roborecover_intervention": _of_class(RoboRecoverInterventionConfig, "--policy."),
        "--optimizer.type=roborecover_ema_adamw": _of_class(ema.EmaAdamWConfig, "--optimizer."),
        "--reward_model.type=roborecover_monitor": _of_class(
            configuration_roborecover_monitor.RoboRecoverMonitorConfig, "--reward_model."
        ),
        "--reward_model.type=roborecover_monitor_small": _of_class(
            configuration_roborecover_monitor_small.RoboRecoverMonitorSmallConfig, "--reward_model."
        ),
    }


def _of_parser(parser: argparse.ArgumentParser) -> Options:
    return {
        " ".join(action.option_strings) or action.dest: _of_action(action)
        for action in parser._actions
        if not isinstance(action, argparse._HelpAction)
    }


def _of_action(action: argparse.Action) -> dict[str, Any]:
    if isinstance(action, OldName):
        return {"old_name_of": action.new}
    said = {
        "positional": not action.option_strings,
        "required": action.required and bool(action.option_strings),
        "switch": isinstance(action, argparse._StoreTrueAction),
        "repeated": isinstance(action, argparse._AppendAction),
        "nargs": None if isinstance(action, argparse._StoreTrueAction) else action.nargs,
        "metavar": action.metavar,
        "choices": None if action.choices is None else list(action.choices),
    }
    told = {key: value for key, value in said.items() if value is not None and value is not False}
    return told | ({} if told.get("switch") or action.default is None else {"default": action.default})


def _of_class(kind: type, prefix: str, without: type | None = None) -> Options:
    """Fields that a config or a base of ours declares, with those of configs within it.

    Args:
        kind: a dataclass.
        prefix: of its options.
        without: a base whose fields are listed elsewhere.
    """
    ours = {
        name
        for base in kind.__mro__
        if base.__module__.startswith("lerobot_roborecover.") and base is not without
        for name in inspect.get_annotations(base)
    }
    found: Options = {}
    for field in dataclasses.fields(kind):
        if field.name not in ours:
            continue
        default = _default(field)
        if dataclasses.is_dataclass(default):
            found |= _of_class(type(default), f"{prefix}{field.name}.")
        else:
            found[prefix + field.name] = {"default": default}
    return found


def _default(field: dataclasses.Field) -> Any:
    if field.default is not dataclasses.MISSING:
        return field.default
    return field.default_factory() if field.default_factory is not dataclasses.MISSING else "required"


def plain(table: dict[str, Options]) -> dict[str, Options]:
    """As it is read back from the file."""
    return json.loads(json.dumps(table, default=str))


def written(name: str) -> dict[str, Options]:
    """A part of the file: `ours`, or `lerobots`."""
    return json.loads(FILE.read_text(encoding="utf-8"))[name]


def as_text(tables: dict[str, dict[str, Options]]) -> str:
    """An option a line, by name."""
    parts = []
    for name, table in tables.items():
        commands = [
            f"  {json.dumps(command)}: {{\n"
            + ",\n".join(f"   {json.dumps(k)}: {json.dumps(v)}" for k, v in sorted(options.items()))
            + "\n  }"
            for command, options in sorted(table.items())
        ]
        parts.append(f" {json.dumps(name)}: {{\n" + ",\n".join(commands) + "\n }")
    return "{\n" + ",\n".join(parts) + "\n}\n"


if __name__ == "__main__":
    FILE.write_text(
        as_text({"ours": plain(our_options()), "lerobots": plain(lerobots_options())}), encoding="utf-8"
    )
