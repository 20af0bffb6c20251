"""The commands whose options are a LeRobot configuration: what can be refused is refused before LeRobot's
import."""

from __future__ import annotations

import ast
import importlib
import os
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.early_checks import (
    ENV,
    POLICY,
    CommandLine,
    ConfigSource,
    env_class,
    env_types,
    join_values,
    policy_types,
    recovery_options,
)
from lerobot_roborecover.evaluation.options import ALIASES, JSON
from lerobot_roborecover.platforms import all_platforms
from lerobot_roborecover.platforms.env_options import LEROBOT_OPTIONS, NOT_OPTIONS
from lerobot_roborecover.platforms.registry import env_type_of
from lerobot_roborecover.utils.config_source import SourceClass, SourceField, nested_class, read_class

_PACKAGE = __name__.partition(".")[0]
_INDENT, _WIDTH = 6, 100
_CONFIG_PATH = "YAML file of options, nested as their names are; the command line wins."
_POLICY_PATH = (
    "Folder or Hub id of a LeRobot checkpoint, with its processors: what lerobot-train wrote, or "
    "save_pretrained."
)
_LEROBOTS = {
    **LEROBOT_OPTIONS,
    "device": "Where the policy runs: `cuda`, `cuda:0`, `mps` or `cpu`; else as the checkpoint says.",
    "output_dir": "Folder of the trial log, the results and the videos; a new one by default.",
    "job_name": "Part of the name of that new folder.",
    "seed": "Of the run: trial k of a scenario draws its noise from it, the scenario and k.",
    "rename_map": "The environment's observation keys to the policy's, as JSON.",
    "trust_remote_code": "Run the code that an environment on the Hub brings.",
}
"""What LeRobot's own options are, where its source does not say it or says it of another use."""
_UNUSED = ("eval.batch_size", "eval.use_async_envs", "eval.recording")
"""LeRobot's, without effect here: beginnings of names."""


@dataclass(frozen=True)
class ConfigCommand:
    """A command whose options are a LeRobot configuration."""

    HELP: str
    """What it does."""
    source: ConfigSource
    """Which options there are."""
    main: str
    """`module:function` that takes the command line, without the command's name."""
    check: Callable[[CommandLine], None] | None = None
    """Refuses more of what the command line says."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Environment variables that are set where the user has not."""

    def pass_through(self, argv: Sequence[str]) -> int:
        """Prints the help, or refuses what is wrong; else hands the command line to LeRobot's parser.

        Args:
            argv: arguments without the command's name.

        Returns:
            Exit status.

        Raises:
            OptionError: naming what is wrong, and what is nearest to it.
        """
        for name, value in self.environment.items():
            os.environ.setdefault(name, value)
        words = join_values(argv)
        if {"-h", "--help"} & set(words):
            rest = [word for word in words if word not in ("-h", "--help")]
            print(help_text(self.source, self.HELP, rest))
            return 0
        line = CommandLine(self.source, words)
        line.check()
        if self.check is not None:
            self.check(line)
        module, _, function = self.main.partition(":")
        return getattr(importlib.import_module(module), function)(words)


def _check_plan(line: CommandLine) -> None:
    """Refuses a plan, or policies of it, that cannot be used."""
    from lerobot_roborecover.robot.plan import check_policies, read_plan

    path = Path(line.value("plan") or "plan.yaml")
    if path.is_file():
        check_policies(read_plan(path))


EVAL = ConfigCommand(
    "evaluate a policy, every simulator busy; takes lerobot-eval's arguments and --runner.*",
    ConfigSource(
        "roborecover eval",
        (f"{_PACKAGE}.evaluation.runner", "RecoveryEvalConfig"),
        required=(ENV, POLICY),
        short=ALIASES,
    ),
    f"{_PACKAGE}.evaluation.runner:main",
    CommandLine.check_action_widths,
    # Read when torch is loaded: threads of a policy on the CPU that spin while they wait for each other take
    # the cores from the simulators. It changes no number.
    environment={"OMP_WAIT_POLICY": "PASSIVE"},
)
CHECK_POLICY = ConfigCommand(
    "try a policy for a few steps and look for the usual mistakes; takes lerobot-eval's arguments, --json",
    ConfigSource(
        "roborecover check policy",
        (f"{_PACKAGE}.evaluation.check_policy", "CheckPolicyConfig"),
        required=(ENV, POLICY),
        short=JSON,
    ),
    f"{_PACKAGE}.evaluation.check_policy:main",
)
SERVE = ConfigCommand(
    "serve a LeRobot policy over openpi's websocket protocol; takes --policy.path, --host and --port",
    ConfigSource(
        "roborecover serve",
        (f"{_PACKAGE}.policies.remote.serve", "ServeConfig"),
        chosen=(POLICY,),
        required=(POLICY,),
    ),
    f"{_PACKAGE}.policies.remote.serve:main",
)
CAPTURE = ConfigCommand(
    "Run a policy on a robot, always recording, and mark where something goes wrong; takes LeRobot's "
    "--robot.*, --teleop.* and --policy.*.",
    ConfigSource(
        "roborecover robot capture",
        (f"{_PACKAGE}.robot.commands", "CaptureConfig"),
        chosen=(POLICY,),
        required=(POLICY,),
    ),
    f"{_PACKAGE}.robot.commands:run_capture",
)
RESTORE = ConfigCommand(
    "Put a robot and its scene back to a recovery point, and measure how far off the start is; takes "
    "LeRobot's --robot.*.",
    ConfigSource("roborecover robot restore", (f"{_PACKAGE}.robot.commands", "RestoreConfig"), chosen=()),
    f"{_PACKAGE}.robot.commands:run_restore",
)
RUN_PLAN = ConfigCommand(
    "Run a plan of recovery points and policies on a robot, blind and in random order; takes LeRobot's "
    "--robot.* and --teleop.*.",
    ConfigSource("roborecover robot run", (f"{_PACKAGE}.robot.commands", "PlanRunConfig"), chosen=()),
    f"{_PACKAGE}.robot.commands:run_plan",
    _check_plan,
)


def help_text(source: ConfigSource, about: str, words: Sequence[str]) -> str:
    """Returns the help: every option with a sentence, those of a policy where the command line names one.

    Args:
        source: which options there are.
        about: what the command does.
        words: the rest of the command line.
    """
    line = CommandLine(source, words)
    with suppress(OptionError):
        line.find_policy()
    example = " ".join(
        {ENV: "--env roborecover_PLATFORM", POLICY: "--policy.path=CHECKPOINT"}[one]
        for one in source.chosen
        if one in source.required or one == POLICY
    )
    parts = [f"usage: {source.program} {example} [options]".replace("  ", " "), f"{_sentence(about)}"]
    if POLICY in source.chosen:
        parts.append(_section("policy", _policy_lines(line)))
    if ENV in source.chosen:
        parts.append(_section("scenarios and simulator", _env_lines()))
        for platform in all_platforms():
            kind = env_type_of(platform.name)
            if platform.env_name or (line.env_type and env_types().get(line.env_type) != kind):
                continue
            if own := env_class(platform.name):
                parts.append(_section(f"with --env {kind}", _own_lines(own)))
    parts.append(_section("run", _root_lines(line)))
    if source.short:
        parts.append(_section("short names", [f"  --{s}  is --{long}" for s, long in source.short.items()]))
    return "\n\n".join(parts)


def _section(title: str, lines: Sequence[str]) -> str:
    return "\n".join([f"{title}:", *lines])


def _entry(name: str, value: str, doc: str, default: str = "") -> str:
    sentence = _sentence(doc)
    if default:
        sentence = f"{sentence.removesuffix('.')} ({default})"
    return f"  --{name}{value}\n{textwrap.indent(textwrap.fill(sentence, _WIDTH - _INDENT), ' ' * _INDENT)}"


def _sentence(doc: str) -> str:
    text = " ".join(doc.split())
    return text[:1].upper() + text[1:] + ("" if not text or text.endswith(".") else ".")


def _of_fields(head: str, owner: SourceClass) -> Iterator[str]:
    for one in owner.fields.values():
        name = f"{head}{one.name}"
        if one.name in NOT_OPTIONS or name.startswith(_UNUSED) or one.doc.startswith("Earlier name of"):
            continue
        inner = nested_class(one)
        if inner is not None and not inner.choice:
            yield from _of_fields(f"{name}.", inner)
        elif inner is not None:
            yield _entry(
                f"{name}.type", "=NAME", f"{_doc(name, one).removesuffix('.')}; its own are --{name}.OPTION"
            )
        else:
            yield _entry(name, "=" + _value(one), _doc(name, one), _default(one))


def _doc(name: str, one: SourceField) -> str:
    ours = _LEROBOTS.get(name) or _LEROBOTS.get(one.name, "")
    return ours if ours and one.module.startswith("lerobot.") else one.doc or ours


def _value(one: SourceField) -> str:
    kind = one.kind.removesuffix(" | None")
    return {"int": "N", "float": "X", "bool": "true|false", "Path": "PATH"}.get(kind, "VALUE")


def _default(one: SourceField) -> str:
    """A default that is a plain value, as it is typed; empty where the docstring says it."""
    try:
        value = ast.literal_eval(re.sub(r"^Path\((.*)\)$", r"\1", one.default))
    except (ValueError, SyntaxError):
        return ""
    if value in ("", None) or "default" in one.doc.lower():
        return ""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _policy_lines(line: CommandLine) -> list[str]:
    lines = [_entry("policy.path", "=CHECKPOINT", _POLICY_PATH)]
    if ENV in line.source.chosen:
        types = " or ".join(sorted(name for name in policy_types() if name.startswith("roborecover_")))
        doc = f"In place of a checkpoint: {types}; --help with one shows its options."
        lines.append(_entry("policy.type", "=TYPE", doc))
    own = line.classes().get(POLICY)
    if own is None:
        base = read_class("lerobot.configs.policies", "PreTrainedConfig")
        doc = (
            "Any option of the policy's own configuration, e.g. --policy.n_action_steps=10; --help with a "
            "checkpoint shows its options."
        )
        lines.append(_entry("policy.OPTION", "=VALUE", doc))
        own = base and SourceClass(base.module, base.name, {"device": base.fields["device"]})
    return lines + list(_of_fields("policy.", own)) if own else lines


def _env_lines() -> list[str]:
    names = ", ".join(dict.fromkeys(env_types().values()))
    lines = [_entry("env", " TYPE", f"Which simulator: {names}")]
    return lines + list(_of_fields("env.", recovery_options()))


def _own_lines(own: SourceClass) -> list[str]:
    common = {*recovery_options().fields, "max_parallel_tasks"}
    fields = {name: one for name, one in own.fields.items() if name not in common}
    return list(_of_fields("env.", SourceClass(own.module, own.name, fields)))


def _root_lines(line: CommandLine) -> list[str]:
    fields = {name: one for name, one in line.root.fields.items() if name not in line.source.chosen}
    own = SourceClass(line.root.module, line.root.name, fields)
    return [_entry("config_path", "=FILE", _CONFIG_PATH), *_of_fields("", own)]
