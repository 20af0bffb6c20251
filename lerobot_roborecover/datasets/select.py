"""The selection language, and the checks of a set against the platform that is to run it.

An expression is terms separated by ";", all of which must hold. A term is `key=value`, or `key=value|value`
for any of several; values take the shell wildcards `*`, `?` and `[...]` and are compared with case. Keys: id,
suite, task, stage, type, cell, source, policy, split. Example:

    suite=libero_goal|libero_10; source=natural; cell=Approach-*
"""

from __future__ import annotations

import fnmatch
from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from lerobot_roborecover.scenario import Scenario, ScenarioError

_KEYS: dict[str, Callable[[Scenario], str]] = {
    "id": lambda s: s.id,
    "suite": lambda s: s.task.suite,
    "task": lambda s: s.task.name,
    "stage": lambda s: s.stage.value,
    "type": lambda s: s.deviation.value,
    "cell": lambda s: s.cell,
    "source": lambda s: s.source.value,
    "policy": lambda s: s.source_policy,
    "split": lambda s: s.split,
}
_SHOWN_VALUES = 20


def parse(expression: str) -> list[tuple[str, tuple[str, ...]]]:
    """The terms of an expression as (key, patterns); none for a blank expression.

    Raises:
        ScenarioError: a term is empty or has no `key=value` form, or a key is unknown.
    """
    if not expression.strip():
        return []
    terms = []
    for number, term in enumerate(expression.split(";"), 1):
        key, equals, values = (part.strip() for part in term.partition("="))
        patterns = tuple(value.strip() for value in values.split("|"))
        if not equals or not key or not all(patterns):
            raise ScenarioError(
                f"selection {expression!r}: term {number} is {term.strip()!r}; write key=value or "
                f"key=value|value, terms separated by ';'. Keys: {', '.join(_KEYS)}"
            )
        if key not in _KEYS:
            raise ScenarioError(f"selection {expression!r}: unknown key {key!r}. Keys: {', '.join(_KEYS)}")
        terms.append((key, patterns))
    return terms


def select_scenarios(scenarios: Sequence[Scenario], expression: str) -> list[Scenario]:
    """The scenarios for which every term holds, in their order.

    Raises:
        ScenarioError: the expression is malformed, one of its values matches no scenario at all (a
            misspelling would otherwise shrink a selection unseen), or nothing is left; the message lists what
            there is.
    """
    terms = parse(expression)
    for key, patterns in terms:
        values = {_KEYS[key](s) for s in scenarios}
        for pattern in patterns:
            if not any(fnmatch.fnmatchcase(value, pattern) for value in values):
                raise ScenarioError(
                    f"selection {expression!r}: {key}={pattern} matches none of {len(scenarios)} scenarios. "
                    f"There are: {_tally(scenarios, key)}"
                )
    chosen = [
        s
        for s in scenarios
        if all(any(fnmatch.fnmatchcase(_KEYS[k](s), p) for p in patterns) for k, patterns in terms)
    ]
    if not chosen:
        listed = "; ".join(f"{key}: {_tally(scenarios, key)}" for key in dict.fromkeys(k for k, _ in terms))
        raise ScenarioError(
            f"selection {expression!r} is empty: no scenario fulfils all its terms at once. "
            f"There are {listed}"
        )
    return chosen


def _tally(scenarios: Iterable[Scenario], key: str) -> str:
    """The values of a key with their numbers, the most frequent first."""
    found = Counter(_KEYS[key](s) for s in scenarios)
    shown = ", ".join(f"{value} ({count})" for value, count in found.most_common(_SHOWN_VALUES))
    more = len(found) - _SHOWN_VALUES
    return shown + (f", and {more} more" if more > 0 else "")


def validate_for(scenarios: Sequence[Scenario], platform: str) -> None:
    """Checks that a platform can run every scenario, before any simulator starts.

    Args:
        scenarios: what is to be run.
        platform: that of the env type which is to run it, e.g. `libero` for `roborecover_libero`.

    Raises:
        ScenarioError: there are none, they are of another platform, or a suite or task is unknown to the
            platform.
    """
    from lerobot_roborecover.platforms import platform_named

    own = platform_named(platform)
    if not scenarios:
        raise ScenarioError("there are no scenarios to run; check the selection")
    for scenario in scenarios:
        if scenario.platform != platform:
            raise ScenarioError(
                f"scenario {scenario.id} is of platform {scenario.platform!r}, but the env type is "
                f"roborecover_{platform}; use --env.type=roborecover_{scenario.platform}"
            )
    checked = set()
    for scenario in scenarios:
        if scenario.task not in checked:
            try:
                own.check_task(scenario.task)
            except ScenarioError as err:
                raise ScenarioError(f"scenario {scenario.id}: {err}") from None
            checked.add(scenario.task)
