"""What of a command line can be refused without LeRobot, whose import takes 10 s or more: names of options,
env types, policy types and checkpoints, and values that are no numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.platforms import all_platforms, platform_named
from lerobot_roborecover.platforms.registry import (
    ENV_PREFIX,
    WRAPPED,
    env_type_of,
    platform_names,
    platform_of,
)
from lerobot_roborecover.policies.checkpoint import (
    check_checkpoint,
    is_other_width,
    nearest_path,
    other_width_problem,
)
from lerobot_roborecover.utils.config_source import (
    SourceClass,
    nested_class,
    read_class,
    registered_classes,
    registrations,
)
from lerobot_roborecover.utils.text import nearest

ENV, POLICY = "env", "policy"
_PLUGINS = ("lerobot_env_", "lerobot_policy_")
"""How names of distributions begin that LeRobot imports for their types."""
_OURS = "lerobot_env_roborecover"
_SPECIAL = ("path", "type", "discover_packages_path")
"""What can be said of a configuration beside its fields."""


@dataclass(frozen=True)
class ConfigSource:
    """Which options a command line may have."""

    program: str
    """As it is typed, e.g. `roborecover eval`."""
    config: tuple[str, str] | None = None
    """Module and class of the configuration; None where another parser reads all but what is chosen."""
    chosen: tuple[str, ...] = (ENV, POLICY)
    """Parts of which one is chosen by name."""
    required: tuple[str, ...] = ()
    """Those of them that must be named."""
    short: Mapping[str, str] | None = None
    """Long names of options that have a short one, with the value where they stand for one:
    `json` for `check.json=true`."""

    @property
    def root(self) -> SourceClass:
        """The configuration."""
        found = read_class(*self.config) if self.config else SourceClass("", "")
        assert found is not None, self.config
        return found


def join_values(argv: Sequence[str], begins: tuple[str, ...] = ("--",)) -> list[str]:
    """`--policy.path X` as `--policy.path=X`, for every option whose value stands behind a space.

    Args:
        argv: arguments.
        begins: how options that are meant begin.
    """
    joined: list[str] = []
    for word in argv:
        bare = joined and joined[-1].startswith(begins) and "=" not in joined[-1]
        if bare and not word.startswith("--"):
            joined[-1] = f"{joined[-1]}={word}"
        else:
            joined.append(word)
    return joined


class CommandLine:
    """Options by name, as a command line and its `--config_path` give them.

    Args:
        source: which options there are.
        words: as `join_values` returns them.

    Raises:
        OptionError: a word belongs to no option, or the file cannot be read.
    """

    def __init__(self, source: ConfigSource, words: Sequence[str]):
        self.source, self.root = source, source.root
        self.given: dict[str, str] = {}
        """Text of each option of the command line, by its long name."""
        self._typed: list[str] = []
        self._checkpoints: dict[str, Mapping[str, Any]] = {}
        short = source.short or {}
        for word in words:
            name, _, value = word.removeprefix("--").partition("=")
            if not word.startswith("--"):
                raise OptionError(f"{word!r:.80} belongs to no option; options are written --NAME=VALUE")
            long, _, fixed = short.get(name, name).partition("=")
            self.given[long] = fixed or value
            if name not in short:
                self._typed.append(name)
        self._configured = "config_path" in self.given
        self._file = self._read_file()
        self._policy_type = self.value("policy.type")

    def _read_file(self) -> Mapping[str, Any]:
        """Returns the content of `--config_path`, where that is a file."""
        path = self.given.get("config_path", "")
        if not path.endswith((".yaml", ".yml", ".json")):
            return {}
        if not Path(path).is_file():
            near = nearest_path(path)
            hint = f"; the nearest is {near}" if near else ""
            raise OptionError(f"--config_path={path}: there is no such file{hint}")
        try:
            found = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        except (OSError, ValueError, yaml.YAMLError) as err:
            words = " ".join(str(err).split())
            raise OptionError(f"--config_path={path}: cannot be read ({words:.200})") from None
        return found if isinstance(found, Mapping) else {}

    def value(self, name: str) -> str:
        """The text of an option, of the command line or else of the file; empty where neither has it."""
        if name in self.given:
            return self.given[name]
        found: Any = self._file
        for part in name.split("."):
            found = found.get(part) if isinstance(found, Mapping) else None
        return "" if found is None or isinstance(found, (Mapping, list)) else str(found)

    def check(self) -> None:
        """Refuses what is wrong.

        Raises:
            OptionError: naming it, and what is nearest to it.
        """
        if ENV in self.source.chosen:
            self._check_env()
        if POLICY in self.source.chosen:
            self._check_policy()
        chosen = self.classes()
        for name in self._typed:
            self._check_name(name, chosen)
        for name, text in self.given.items():
            _check_kind(f"--{name}", self._kind(name, chosen), text)
        if ENV in self.source.chosen:
            self._check_recovery_options()

    # --- what is named

    @property
    def env_type(self) -> str:
        """The env type; empty where none is named."""
        bare = self.given.get(ENV, "")
        return self.value("env.type") or ("" if Path(bare).is_file() else bare)

    def _elsewhere(self) -> bool:
        """Returns whether other packages may bring types that only LeRobot's import makes known."""
        from importlib import metadata

        names = ((d.metadata["Name"] or "").lower().replace("-", "_") for d in metadata.distributions())
        plugins = any(name.startswith(_PLUGINS) and name != _OURS for name in names)
        return plugins or any("discover_packages_path" in name for name in self.given)

    def _check_env(self) -> None:
        kind, types = self.env_type, env_types()
        if self.source.config is None and platform_of(kind) in platform_names():
            return  # a member of a family, under its own name
        there = ", ".join(dict.fromkeys(types.values()))
        if not kind:
            if ENV in self.source.required and not self._configured:
                raise OptionError(f"no environment: give --env with one of {there}")
            return
        if kind in types or self._elsewhere():
            return
        name = "env.type" if "env.type" in self.given else ENV
        bare = {one.removeprefix(ENV_PREFIX): documented for one, documented in types.items()}
        near = nearest(kind.removeprefix(ENV_PREFIX), bare)
        hint = f"the nearest is {bare[near]}" if near else f"there are {there}"
        if not near and kind in registrations("lerobot.envs.configs", "EnvConfig"):
            hint = f"give --env {WRAPPED} --env.base.type={kind}"
        raise OptionError(f"--{name}={kind:.80}: not a recovery env type; {hint}")

    def find_policy(self) -> None:
        """Reads the type of the checkpoint that is named.

        Raises:
            OptionError: it cannot be loaded.
        """
        if path := self.value("policy.path"):
            config = check_checkpoint(path)
            self._policy_type = str(config.get("type", ""))
            self._checkpoints[f"--policy.path={path}"] = config

    def _check_policy(self) -> None:
        path, kind = self.value("policy.path"), self._policy_type
        wanted = POLICY in self.source.required and not self._configured
        if not path and ("policy.path" in self.given or (wanted and not kind)):
            raise OptionError("no policy: give a checkpoint with --policy.path=FOLDER_OR_HUB_ID")
        if path and "policy.type" in self.given:
            raise OptionError(
                f"--policy.type={kind:.80} beside --policy.path: a checkpoint has a type; leave one out"
            )
        self.find_policy()
        if kind and not path and kind not in policy_types() and not self._elsewhere():
            near = nearest(kind, policy_types())
            hint = f"the nearest is {near}" if near else f"there are {', '.join(sorted(policy_types()))}"
            raise OptionError(f"--policy.type={kind:.80}: there is no such policy type; {hint}")
        for member in ("base", "correction"):
            part = self.value(f"policy.{member}.path")
            if part and not path:
                revision = self.value(f"policy.{member}.revision") or None
                label = f"--policy.{member}.path={part}"
                self._checkpoints[label] = check_checkpoint(part, label, revision)

    def check_action_widths(self) -> None:
        """Refuses checkpoints whose actions the platform does not take; after `check`.

        Raises:
            OptionError: naming the checkpoint, and both widths.
        """
        name = platform_of(self.env_type)
        wrapped = name == platform_of(WRAPPED)  # any environment of LeRobot's, with actions of its own
        if wrapped or name not in platform_names() or platform_named(name).env_name:
            return
        widths = platform_named(name).action_widths
        for label, config in self._checkpoints.items():
            found: Any = config
            for part in ("output_features", "action", "shape"):
                found = found.get(part) if isinstance(found, Mapping) else None
            own = found[0] if isinstance(found, list) and len(found) == 1 else None
            padded = config.get("max_action_dim")
            if isinstance(own, int) and is_other_width(str(config["type"]), own, padded, widths):
                raise OptionError(other_width_problem(label, own, self.env_type, widths))

    # --- options

    def classes(self) -> dict[str, SourceClass | None]:
        """Configurations that are chosen by name; None where no source says which options they have."""
        found: dict[str, SourceClass | None] = dict.fromkeys(self.source.chosen)
        if ENV in found and self.env_type:
            found[ENV] = env_class(platform_of(self.env_type))
        if POLICY in found and self._policy_type in policy_types():
            found[POLICY] = read_class(*policy_types()[self._policy_type])
        return found

    def _check_name(self, name: str, chosen: Mapping[str, SourceClass | None]) -> None:
        known: SourceClass | None = self.root
        head = ""
        for part in name.split("."):
            if known is None or not known.complete or (known.choice and not head):
                return
            first = head.rstrip(".") in chosen
            names = {*known.fields, *(_SPECIAL if first else ())}
            if not head:
                names |= {*chosen, "config_path"}
            if part not in names:
                self._refuse_name(name, head, part, names)
                return
            if part not in known.fields and part not in chosen:
                return
            known = chosen[part] if not head and part in chosen else nested_class(known.fields[part])
            if known is not None and known.choice and not (not head and part in chosen):
                return
            head += f"{part}."

    def _refuse_name(self, name: str, head: str, part: str, names: set[str]) -> None:
        """Refuses a name that is no option; LeRobot's parser takes no beginning of one, either."""
        begun = sorted(one for one in names if one.startswith(part))
        if f"{head}{part}" == name and len(begun) > 1:
            raise OptionError(
                f"--{name:.80} can be {', '.join(f'--{head}{one}' for one in begun[:5])}: write it out"
            )
        near = begun[0] if begun else nearest(part, [*names, *(() if head else self.source.short or ())])
        rest = name.removeprefix(f"{head}{part}")
        hint = (
            f"the nearest is --{head}{near}{rest}" if near else f'"{self.source.program} --help" lists them'
        )
        raise OptionError(f"there is no option --{name:.80}; {hint}")

    def _kind(self, name: str, chosen: Mapping[str, SourceClass | None]) -> str:
        """Returns the annotation of an option's field; empty where it is not known."""
        first, _, rest = name.partition(".")
        owner = chosen[first] if rest and first in chosen else self.root
        kind = ""
        for part in (rest if rest and first in chosen else name).split("."):
            one = owner.fields.get(part) if owner is not None else None
            kind = "" if one is None else one.kind
            owner = None if one is None else nested_class(one)
        return kind

    def _check_recovery_options(self) -> None:
        values: dict[str, Any] = {}
        for name, one in recovery_options().fields.items():
            text = self.value(f"env.{name}")
            if text and name != "meanwhile":
                values[name] = text if one.kind.startswith("str") else _read(text)
        RecoveryOptions(**values).check()


def check_env_options(platform: str, options: Sequence[str]) -> None:
    """Refuses options that a platform's env type does not have.

    Args:
        platform: its name.
        options: `NAME=VALUE`, as after `--env.`.

    Raises:
        OptionError: naming the option, and the nearest that there is.
    """
    words = [f"--env.{option.removeprefix('--')}" for option in options]
    kind = ENV_PREFIX + (platform_named(platform).env_name or platform)
    CommandLine(ConfigSource("roborecover eval", chosen=(ENV,)), [f"--env.type={kind}", *words]).check()


def check_policy_options(policy: str, options: Sequence[str]) -> None:
    """Refuses a checkpoint that cannot be loaded, and options that its policy does not have.

    Args:
        policy: folder or Hub id of the checkpoint.
        options: `NAME=VALUE`, as after `--policy.`.

    Raises:
        OptionError: naming what is wrong, and the nearest that there is.
    """
    words = [f"--policy.{option.removeprefix('--')}" for option in options]
    source = ConfigSource("roborecover eval", chosen=(POLICY,))
    CommandLine(source, [f"--policy.path={policy}", *words]).check()


def _read(text: str) -> Any:
    """A value as YAML has it, but for numbers such as 1e-3, which are texts there."""
    if text.lower() in ("none", "null"):
        return None
    value = yaml.safe_load(text)
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _check_kind(label: str, kind: str, text: str) -> None:
    plain = kind.removesuffix(" | None")
    wanted = {"int": "a whole number", "float": "a number", "bool": "true or false"}
    if plain not in wanted or (plain != kind and text.lower() in ("none", "null")):
        return
    try:
        value = _read(text)
    except yaml.YAMLError:
        value = None
    if not isinstance(value, (int, float)) or (plain != "bool" and isinstance(value, bool)):
        raise OptionError(f"{label}={text:.80}: must be {wanted[plain]}")


def env_types() -> dict[str, str]:
    """Names of recovery env types, earlier ones too, with the name that is documented."""
    names = [p.name for p in all_platforms() if not p.env_name]
    return {kind: env_type_of(name) for name in names for kind in (env_type_of(name), ENV_PREFIX + name)}


def policy_types() -> Mapping[str, tuple[str, str]]:
    """Module and class of every policy type that LeRobot and this package bring, by name."""
    registry = "PreTrainedConfig"
    return {
        **registered_classes("lerobot.policies", registry),
        **registered_classes("lerobot_roborecover", registry),
    }


def env_class(platform: str) -> SourceClass | None:
    """The configuration of a platform's env type; None where no source says which options it has.

    Args:
        platform: its name.
    """
    module, _, name = platform_named(platform).env_config_class.partition(":")
    own = read_class(module, name) if name else None
    shared = read_class("lerobot_roborecover.evaluation.env_configs", "RecoveryEnvConfig")
    if own is None or shared is None:
        return None
    fields = {**shared.fields, **own.fields, **recovery_options().fields}
    return SourceClass(own.module, own.name, fields, own.complete)


def recovery_options() -> SourceClass:
    """The options that every recovery env type has."""
    found = read_class(RecoveryOptions.__module__, RecoveryOptions.__name__)
    assert found is not None
    return found
