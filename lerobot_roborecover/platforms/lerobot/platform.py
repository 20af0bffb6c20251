"""What an env type of LeRobot's is besides its simulator: one family, a member per type."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property
from typing import Any, ClassVar

from lerobot_roborecover.platforms.base import Platform
from lerobot_roborecover.platforms.catalog import nearest
from lerobot_roborecover.platforms.lerobot.known import KNOWN, EnvFacts
from lerobot_roborecover.platforms.lerobot.source import EnvSource, registered_tasks
from lerobot_roborecover.platforms.simulator import Simulator, SimulatorError
from lerobot_roborecover.scenario import ScenarioError, Task

FAMILY_NAME = "lerobot"
DEFAULT_TYPE = "pusht"
HUB_TYPE = "hub"
_WIDEST = 64
"""Values in a recorded action, at most (the scenario format's limit)."""


class LeRobotPlatform(Platform):
    """One env type, `lerobot_<type>`; tasks have the type as their suite. `member` makes a subclass each."""

    simulator = "lerobot_roborecover.platforms.lerobot.simulator:LeRobotSimulator"
    extra = "gym"
    env_name = FAMILY_NAME
    env_config_class = "lerobot_roborecover.platforms.lerobot.env_config:LeRobotConfig"
    env_type: ClassVar[str]
    """LeRobot's name; of a type that is not known, as the platform's name has it until LeRobot is asked."""

    @cached_property
    def facts(self) -> EnvFacts:
        """Facts about the type; asks LeRobot's own config where it is not a known one."""
        return KNOWN.get(self.env_type) or _asked_of_lerobot(type_named(self.name))

    def tasks(self, options: Mapping[str, Any] | None = None) -> Sequence[Task]:
        """Returns the tasks that the type's package registers, or that its config makes."""
        given = dict(options or {})
        source = EnvSource.of(given.get("source") or {})
        if source.hub or source.config:
            name = str(given.get("task", "")) or source.name
            horizon = given.get("horizon") or self.facts.horizon
            return [Task(self.name, self.env_type, name, name, int(horizon))]
        names = dict(self.facts.tasks) or dict.fromkeys(registered_tasks(self.facts.package), "")
        return [self._task(name, said) for name, said in names.items()]

    def _task(self, name: str, instruction: str = "") -> Task:
        return Task(self.name, self.env_type, name, instruction or name, self.facts.horizon)

    def task(self, name: str, instruction: str = "", suite: str = "") -> Task:
        """Returns a task by name, also of an env type whose tasks are not listed."""
        if self.env_type in KNOWN:
            return super().task(name, instruction, suite)
        return self._task(name, instruction)

    def check_task(self, task: Task) -> None:
        """By suite; of a known type, also by name."""
        if self.env_type in KNOWN:
            super().check_task(task)
        elif task.suite != self.env_type:
            raise ScenarioError(f"{self.name} has no suite {task.suite!r}; there is {self.env_type}")

    def short_name(self, task: Task) -> str:
        return f"{self.env_type}.{task.name}"

    def unsupported_reason(self, task: Task) -> str:
        """Aloha's insertion has no script."""
        return "its controller transfers the cube alone" if task.name == "AlohaInsertion-v0" else ""

    def make_simulator(self, **options: Any) -> Simulator:
        """See `Platform.make_simulator`; what is not given is the type's own.

        Args:
            options: `source`, `task` and `control_hz` of `LeRobotSimulator`, as an env config gives them; or
                `obs_type` and the size of pictures, for a known type.
        """
        given: dict[str, Any] = dict(options)
        seen = {name: given.pop(name) for name in _SEEN if name in given}
        if "source" not in given:
            facts = self.facts
            task = next(iter(facts.tasks), "") or next(iter(registered_tasks(facts.package)), "")
            given = {**given, "source": EnvSource(facts.package, facts.kwargs).as_options(), "task": task}
        given["source"] = self._seen_as(EnvSource.of(given["source"]), seen).as_options()
        known = KNOWN.get(self.env_type)
        if "control_hz" not in given:
            given["control_hz"] = self.facts.control_hz
        given.setdefault("exact_snapshots", bool(known and known.exact_snapshots))
        return super().make_simulator(env_type=self.env_type, platform=self.name, **given)

    def _seen_as(self, source: EnvSource, wanted: Mapping[str, Any]) -> EnvSource:
        """The source with other observations, as far as its environment has them."""
        known = KNOWN.get(self.env_type)
        if known and wanted.get("obs_type") == "state":
            wanted = {**wanted, "obs_type": known.kwargs["obs_type"]}
        kwargs = {k: v for k, v in wanted.items() if known or k in source.kwargs}
        config = {k: v for k, v in wanted.items() if k in source.config}
        if source.package:
            return replace(source, kwargs={**source.kwargs, **kwargs})
        return replace(source, config={**source.config, **config}) if source.config else source

    def owns_observation(self, observation: Mapping[str, tuple[int, ...]]) -> bool:
        """By the widths of its states."""
        known = KNOWN.get(self.env_type)
        if known is None:
            return False
        environment = observation.get("observation.environment_state", (known.environment_width,))
        same = observation.get("observation.state", ())[-1:] == (known.state_width,)
        return same and environment[-1:] == (known.environment_width,)


_SEEN = (
    "obs_type",
    *(f"{what}_{side}" for what in ("observation", "visualization") for side in ("height", "width")),
)
"""Options of environments that decide what is seen of them, and no physics."""


class LeRobotEnvPlatform(Platform):
    """`--env roborecover_wrapped --env.base.type=NAME`: every member under one env type."""

    name: ClassVar[str] = FAMILY_NAME
    title = "LeRobot's env types"
    action_widths: ClassVar[tuple[int, ...]] = (2,)
    control_hz = 10.0
    extra = "gym"
    simulator = "lerobot_roborecover.platforms.lerobot.simulator:LeRobotSimulator"
    env_config_class = "lerobot_roborecover.platforms.lerobot.env_config:LeRobotConfig"
    default_scenarios = "pusht_starter"

    def resolve(self, options: Sequence[str]) -> Platform:
        """The platform that `base.type=NAME` names; PushT where nothing does."""
        chosen = [o.partition("=")[2] for o in options if o.lstrip("-").startswith("base.type=")]
        return member(member_name(chosen[-1] if chosen else DEFAULT_TYPE))

    def members(self) -> tuple[str, ...]:
        """Env types that are known without LeRobot."""
        return tuple(member_name(kind) for kind in KNOWN)

    def tasks(self, options: Mapping[str, Any] | None = None) -> Sequence[Task]:
        return member(member_name(DEFAULT_TYPE)).tasks(options)

    def make_simulator(self, **options: Any) -> Simulator:
        return member(member_name(DEFAULT_TYPE)).make_simulator(**options)


FAMILY = LeRobotEnvPlatform()


def member_name(env_type: str) -> str:
    """The platform's name of an env type."""
    plain = re.sub(r"[^a-z0-9_]", "_", env_type.lower())
    return f"{FAMILY_NAME}_{plain}"[:40]


@cache
def member(name: str) -> LeRobotPlatform:
    """A member by its platform name. Whether LeRobot has the type is asked where its facts are needed: that
    takes fifteen seconds.

    Args:
        name: `lerobot_<type>`.
    """
    kind = name.removeprefix(f"{FAMILY_NAME}_")
    known = KNOWN.get(kind)
    width = len(known.action_names) if known else 0
    members = {
        "name": name,
        "env_type": kind,
        "title": known.title if known else f"LeRobot's {kind}",
        "env_defaults": {"base": {"type": kind}},
        "control_hz": known.control_hz if known else float("nan"),
        "action_widths": (width,) if known else tuple(range(1, _WIDEST + 1)),
        "action_bound": float("inf"),
        "action_names": {width: known.action_names} if known else {},
        "required_versions": {"lerobot": ("0.6.1",), **known.versions} if known else {},
        "default_scenarios": known.scenarios if known else "",
        "experts": known.experts if known else {},
        "perturbation": known.perturbation if known else (),
        "perturbable": bool(known and known.perturbation),
        "why_not_perturbable": (
            f"no perturbation range is known for actions of env type {kind}, which have their own units"
        ),
    }
    return type("LeRobotMember", (LeRobotPlatform,), members)()


def type_named(name: str) -> str:
    """LeRobot's name of the env type of a member that is not known; imports LeRobot.

    Args:
        name: `lerobot_<type>`.

    Raises:
        ScenarioError: LeRobot has no such env type.
    """
    from lerobot_roborecover.platforms.lerobot.env_config import base_types

    types = {member_name(t): t for t in base_types()}
    if name not in types:
        kind = name.removeprefix(f"{FAMILY_NAME}_")
        raise ScenarioError(
            f"LeRobot has no env type {kind!r:.80}{nearest(kind, set(types.values()))}. Is the package that "
            "brings it installed?"
        )
    return types[name]


def _asked_of_lerobot(env_type: str) -> EnvFacts:
    """Facts of a type from LeRobot's own config of it; imports LeRobot."""
    from lerobot_roborecover.platforms.lerobot.env_config import default_base, source_of

    if env_type == HUB_TYPE:
        raise SimulatorError(
            "an environment of the Hub is named with --env.base.hub_path=user/name@commit (and "
            "--env.trust_remote_code=true)"
        )
    base = default_base(env_type)
    source = source_of(base)
    return EnvFacts(
        package=source.package,
        title=f"LeRobot's {env_type}",
        tasks={base.task: ""} if source.package and base.task else {},
        horizon=int(getattr(base, "episode_length", None) or 300),
        control_hz=float(base.fps),
        action_names=(),
        kwargs=source.kwargs,
        state_width=0,
    )
