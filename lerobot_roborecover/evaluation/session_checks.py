"""What is refused before a run starts: versions, robots, batch sizes and interventions that do not fit."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from lerobot_roborecover.datasets import ScenarioSet
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms.robot_fingerprint import (
    NAME,
    SAME,
    RobotComparison,
    compare_robots,
    is_robot_entry,
)
from lerobot_roborecover.platforms.versions import STAMPS, installed, version_problems
from lerobot_roborecover.policies.interventions.options import InterventionFacts
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.scenario import Start

logger = logging.getLogger(__name__)

_ONE_ENVIRONMENT = ("lingbot_va",)
"""Policies that LeRobot's own evaluator can ask about one environment at a time only
(`modeling_lingbot_va.py`, "single-environment eval")."""


def check_batch(facts: PolicyMetadata) -> None:
    """Refuses a batch that does not divide the trials, of which LeRobot would run extra ones and drop them,
    and a batch for a policy that keeps the history of one environment."""
    if facts.policy_type in _ONE_ENVIRONMENT and facts.batch_size not in (None, 1) and facts.n_episodes != 1:
        raise OptionError(
            f"--eval.batch_size={facts.batch_size}: LeRobot's {facts.policy_type} keeps the "
            "history of one environment. Use --eval.batch_size=1, or roborecover eval, which gives every "
            "slot an instance that shares the weights"
        )
    if facts.lerobots_batch:
        return  # the size is LeRobot's default, and the trials beyond the number cost no simulator
    if facts.n_episodes and facts.batch_size and facts.n_episodes % facts.batch_size:
        divisors = [d for d in range(1, facts.n_episodes + 1) if facts.n_episodes % d == 0]
        if facts.batch_size > facts.n_episodes:
            return  # LeRobot lowers it to the number of episodes
        raise OptionError(
            f"--eval.batch_size={facts.batch_size} does not divide --eval.n_episodes={facts.n_episodes}. "
            f"Use one of {divisors}"
        )


def _robot_problems(scenarios: ScenarioSet, assets: Mapping[str, str]) -> list[str]:
    """One sentence for each other robot that scenarios were recorded on; lesser differences are logged."""
    if not any(is_robot_entry(name) for name in assets):
        return []
    found: dict[RobotComparison, list[str]] = {}
    for scenario in scenarios:
        if scenario.fingerprint is not None:
            robots = compare_robots(scenario.fingerprint.versions, assets)
            if robots != SAME:
                found.setdefault(robots, []).append(scenario.id)
    name, problems = assets.get(NAME, "robot"), []
    for robots, ids in found.items():
        others = f" (and {len(ids) - 1} more)" if len(ids) > 1 else ""
        if not robots.known:
            logger.warning(
                "scenario %s%s does not say which robot recorded it; if that was another one, its handoff "
                "ends as state_mismatch. Record it again to have the robots compared",
                ids[0],
                others,
            )
            continue
        text = f"scenario {ids[0]}{others} was recorded on another robot than the {name} here: {robots}"
        if robots.another:
            problems.append(text + ". Put the platform's own robot in place (roborecover doctor)")
        else:
            logger.warning("%s; its arms reach the same places, and the check of every handoff decides", text)
    return problems


def check_versions(scenarios: ScenarioSet, platform: str, assets: Mapping[str, str], strict: bool) -> None:
    """Compares installed versions with those scores are defined on and those the scenarios were recorded
    with."""
    problems = version_problems(platform)
    recorded: dict[tuple[str, str], str] = {}
    for scenario in scenarios:
        if scenario.fingerprint is not None:
            for item in scenario.fingerprint.versions.items():
                recorded.setdefault(item, scenario.id)
    problems += _robot_problems(scenarios, assets)
    for (name, version), scenario_id in sorted(recorded.items()):
        if is_robot_entry(name):
            continue
        if assets.get(name, version) != version:
            # A warning: the 2 mm check of every handoff decides whether the difference matters.
            logger.warning(
                "scenario %s was recorded with %s %s; here it is %s", scenario_id, name, version, assets[name]
            )
        here = installed(name)
        if name not in STAMPS and here is not None and here != version:
            problems.append(f"scenario {scenario_id} was recorded with {name} {version}; here it is {here}")
    if not problems:
        return
    if strict:
        raise OptionError(
            "versions that decide scores differ: "
            + "; ".join(problems)
            + ". Install the versions named, or accept "
            "scores that cannot be compared with others': --env.strict_versions=false"
        )
    for problem in problems:
        logger.warning("scores will not compare with others': %s", problem)


def check_intervention(facts: InterventionFacts, start: Start) -> None:
    if facts.mode == "reversion" and start is not Start.RECOVERY:
        where = "is at the task's start" if start is Start.INITIAL else "goes back itself"
        raise OptionError(
            f"--policy.mode=reversion with --env.start={start.value}: a rewind beyond the start; this start "
            f"{where}. Use --env.start=recovery"
        )
