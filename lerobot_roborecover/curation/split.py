"""Divides scenarios into splits that share nothing they must not, in the wanted sizes, as balanced as can be.

What two scenarios share that would leak from one split into another (paper, appendix "Corpus Composition"):

- trajectory: the same source trajectory, by its name (`cluster`) or because one prefix is the beginning of
  the other from the same reset;
- record: the same source record (`provenance.source_record`), or the same recovery state;
- instruction: the same task and instruction. On RoboTwin, where instructions vary within a task; elsewhere
  all scenarios of a task share one;
- start: the same task from the same reset (init state, seed), with any controller.

Scenarios that share anything, directly or through others, form a group that stays together. Groups of the
same make-up (how many scenarios of each cell, source and suite) are interchangeable, so the sizes are an
integer programme over kinds of groups: exact counts, and each split's composition as near to its share,
rounded down or up, as can be. The seed decides which groups of a kind go where, and which of several equally
good programmes is taken.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.curation.split_programme import AXES, JOINT, divide_groups
from lerobot_roborecover.errors import check_seed
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.options import internal, option

APART = ("trajectory", "record", "instruction", "start")
UNSCREENED = "unscreened"
"""Split of the scenarios that stay whatever screening policies do with them."""
MEASURED = ("test", UNSCREENED)
"""Splits that policies are measured on: nothing is trained on them."""


def _apart(text: str) -> tuple[str, ...] | None:
    return parse_apart(text)


@dataclass(frozen=True)
class SplitConfig:
    """How to divide."""

    sizes: Mapping[str, int | float] = internal(factory=dict)
    """By split: a number of scenarios, or a fraction below 1; all of one kind. Counts are met exactly,
    fractions as closely as the groups allow."""
    seed: int = 42
    """Seed of the draw."""
    apart: tuple[str, ...] | None = option(None, name="disjoint-by", parse=_apart)
    """What no two splits may share, of `APART`; None takes what fits the platform."""
    least: Mapping[str, Mapping[str, int]] = internal(factory=dict)
    """By split and by `cell`, `source` or `suite`: how many scenarios of each at least, where the set has as
    many. The rest is balanced as ever."""
    no_scarce: bool = False
    """Where the set has fewer than --min-per-split asks for, that split gets none of them."""

    def __post_init__(self):
        check_seed(self.seed)


def parse_sizes(given: Mapping[str, str]) -> dict[str, int | float]:
    """Sizes as they are written on a command line.

    Raises:
        ScenarioError: one is neither a count nor a fraction, or they are of both kinds.
    """
    sizes: dict[str, int | float] = {}
    for name, text in given.items():
        try:
            sizes[name] = float(text) if "." in text else int(text)
        except ValueError:
            raise ScenarioError(_no_size(name, text)) from None
    return check_sizes(sizes)


def check_sizes(sizes: Mapping[str, int | float]) -> dict[str, int | float]:
    """Checks sizes: counts, or fractions that add up to 1.

    Raises:
        ScenarioError: one is neither a count nor a fraction, or they are of both kinds.
    """
    for name, value in sizes.items():
        if not (0 < value < 1 if isinstance(value, float) else 0 <= value <= 10**9):
            raise ScenarioError(_no_size(name, str(value)))
    if len(sizes) < 2:
        raise ScenarioError("name at least two splits, e.g. --train 800 --test 200 or --train 0.8 --test 0.2")
    if len({type(v) for v in sizes.values()}) > 1:
        raise ScenarioError(f"sizes {dict(sizes)} mix counts and fractions; write one kind")
    if all(isinstance(v, float) for v in sizes.values()) and abs(sum(sizes.values()) - 1) > 1e-6:
        raise ScenarioError(f"fractions {dict(sizes)} add up to {sum(sizes.values()):g}, not to 1")
    return dict(sizes)


def _no_size(name: str, text: str) -> str:
    return f"split {name!r:.40}: size {text!r:.40} is neither a count nor a fraction like 0.8"


def parse_apart(text: str | None) -> tuple[str, ...] | None:
    """Keys as they are written on a command line.

    Raises:
        ScenarioError: one is unknown.
    """
    if text is None:
        return None
    keys = tuple(key.strip() for key in text.split(",") if key.strip())
    unknown = [key for key in keys if key not in APART]
    if unknown or not keys:
        raise ScenarioError(
            f"--disjoint-by {text!r:.80}: {unknown[:1] or 'nothing'} is not of {', '.join(APART)}"
        )
    return keys


def parse_least(given: Iterable[str]) -> dict[str, dict[str, int]]:
    """Least numbers as they are written on a command line, e.g. `test:cell=12`.

    Raises:
        ScenarioError: one is not written so.
    """
    least: dict[str, dict[str, int]] = defaultdict(dict)
    for text in given:
        split, _, rest = text.partition(":")
        axis, _, number = rest.partition("=")
        if not number.strip().isdecimal():
            raise ScenarioError(
                f"--min-per-split {text!r:.60} is not written SPLIT:KEY=NUMBER, e.g. test:cell=12"
            )
        least[split.strip()][axis.strip()] = int(number)
    return dict(least)


def check_least(least: Mapping[str, Mapping[str, int]], sizes: Collection[str]) -> None:
    """Checks that least numbers are of splits and keys that there are.

    Raises:
        ScenarioError: they are not.
    """
    keys = [axis for axis in AXES if axis != JOINT]
    for split, numbers in least.items():
        if split not in sizes:
            raise ScenarioError(f"least: no split is called {split!r:.40}; there are {', '.join(sizes)}")
        for axis, number in numbers.items():
            if axis not in keys or number < 0:
                raise ScenarioError(
                    f"least of {split}: {axis!r:.40}: {number}; write a number for one of {', '.join(keys)}"
                )


def apart_for(scenarios: Sequence[Scenario], apart: tuple[str, ...] | None) -> tuple[str, ...]:
    """The keys that hold for a set."""
    if apart is not None:
        return apart
    return platform_named(scenarios[0].platform).apart if scenarios else APART


def shared(scenarios: Sequence[Scenario], apart: Sequence[str]) -> dict[str, dict[str, list[int]]]:
    """What scenarios share: by key and value, the positions of two or more scenarios."""
    found: dict[str, dict[str, list[int]]] = {key: defaultdict(list) for key in apart}
    for i, scenario in enumerate(scenarios):
        if "trajectory" in found and scenario.cluster:
            found["trajectory"][scenario.cluster].append(i)
        if "record" in found:
            found["record"][f"state {scenario.sha256()}"].append(i)
            record = scenario.provenance.get("source_record")
            if isinstance(record, str) and record:
                found["record"][record].append(i)
        if "instruction" in found:
            found["instruction"][f"{scenario.task.name}: {scenario.task.instruction}"].append(i)
        if "start" in found:
            found["start"][" ".join(map(str, start_of(scenario)))].append(i)
    if "trajectory" in found:
        for name, members in _continuations(scenarios):
            found["trajectory"][name] += members
    return {
        key: {value: members for value, members in values.items() if len(members) > 1}
        for key, values in found.items()
    }


def _continuations(scenarios: Sequence[Scenario]) -> Iterable[tuple[str, list[int]]]:
    """Scenarios whose prefix is the beginning of another's, from the same reset: one trajectory, two points.

    The longer one is looked up by each shorter one's length and bytes.
    """
    by_start: dict[tuple, list[int]] = defaultdict(list)
    for i, s in enumerate(scenarios):
        by_start[start_of(s)].append(i)
    for members in by_start.values():
        for i in members:
            # Settling alone is what all rollouts from one reset share.
            short = scenarios[i].prefix
            if len(short) <= scenarios[i].reset.settle_steps:
                continue
            same = [j for j in members if np.array_equal(scenarios[j].prefix[: len(short)], short)]
            if len(same) > 1:
                yield f"beginning of {scenarios[i].id}", same


def start_of(scenario: Scenario) -> tuple:
    """What scenarios that begin in the same simulator state have in common: task, seed, stored init state."""
    task, reset = scenario.task, scenario.reset
    return task.suite, task.name, reset.seed, reset.init_state_index, reset.settle_steps


def groups_of(scenarios: Sequence[Scenario], apart: Sequence[str]) -> list[list[int]]:
    """Positions of scenarios that must stay together, each group in order, the groups by their first id."""
    parent = list(range(len(scenarios)))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for values in shared(scenarios, apart).values():
        for members in values.values():
            for other in members[1:]:
                parent[root(other)] = root(members[0])
    groups: dict[int, list[int]] = defaultdict(list)
    for i in range(len(scenarios)):
        groups[root(i)].append(i)
    ordered = [sorted(members, key=lambda i: scenarios[i].id) for members in groups.values()]
    return sorted(ordered, key=lambda members: scenarios[members[0]].id)


def draw_unscreened(scenarios: Sequence[Scenario], count: int, seed: int) -> set[str]:
    """Draws scenarios before they are screened: whole groups that share a first state, or anything that may
    never be shared, so that no other split shares it with them.

    Args:
        scenarios: of one platform; their order does not matter.
        count: how many at least; the last group may bring a few more.
        seed: of the draw.

    Returns:
        Their ids.

    Raises:
        ScenarioError: there are not as many.
    """
    if count >= len(scenarios) > 0:
        raise ScenarioError(
            f"--unscreened {count}: the dataset has {len(scenarios)}, and some have to be left to screen"
        )
    apart = sorted({*apart_for(scenarios, None), "start"}) if count else ()
    groups, found = groups_of(scenarios, apart) if count else [], set[str]()
    for i in np.random.default_rng(seed).permutation(len(groups)):
        if len(found) >= count:
            break
        found |= {scenarios[k].id for k in groups[i]}
    return found


def assign(scenarios: Sequence[Scenario], config: SplitConfig) -> dict[str, str]:
    """Assigns every scenario to a split.

    Args:
        scenarios: of one platform; their order does not matter.
        config: sizes and seed.

    Returns:
        Split by scenario id.

    Raises:
        ScenarioError: the counts do not add up, or groups make them impossible; the nearest that are
            possible are named. Or the least numbers cannot be met.
    """
    check_least(config.least, config.sizes)
    names = sorted(config.sizes)
    counts = _counts(len(scenarios), config.sizes)
    groups = groups_of(scenarios, apart_for(scenarios, config.apart))
    rng = np.random.default_rng(config.seed)
    kinds: dict[tuple, list[list[int]]] = defaultdict(list)
    for members in groups:
        kinds[tuple(sorted(Counter(AXES[JOINT](scenarios[i]) for i in members).items()))].append(members)
    ordered = sorted(kinds.items())
    # The solver takes the first of several equally good solutions: the order makes it the seed's.
    ordered = [ordered[i] for i in rng.permutation(len(ordered))]
    wanted = np.array([counts[name] for name in names], dtype=float)
    exact = all(isinstance(v, int) for v in config.sizes.values())
    table = divide_groups(
        scenarios, [members for _, members in ordered], wanted, exact, names, config.least, config.no_scarce
    )
    result: dict[str, str] = {}
    for (_, members), row in zip(ordered, table, strict=True):
        targets = [name for name, number in zip(names, row, strict=True) for _ in range(number)]
        for position, target in zip(rng.permutation(len(members)), targets, strict=True):
            result |= {scenarios[i].id: target for i in members[position]}
    return result


def _counts(total: int, sizes: Mapping[str, int | float]) -> dict[str, int]:
    """Counts by split; fractions are rounded by their largest remainders."""
    if all(isinstance(v, int) for v in sizes.values()):
        if sum(sizes.values()) != total:
            missing = total - sum(sizes.values())
            raise ScenarioError(
                f"splits {dict(sizes)} hold {sum(sizes.values())} scenarios; the dataset has {total}. "
                + (f"Add --split unused={missing}, or select first" if missing > 0 else "Ask for fewer")
            )
        return {name: int(v) for name, v in sizes.items()}
    exact = {name: total * v for name, v in sizes.items()}
    counts = {name: int(v) for name, v in exact.items()}
    by_rest = sorted(exact, key=lambda name: (counts[name] - exact[name], name))
    for name in by_rest[: total - sum(counts.values())]:
        counts[name] += 1
    return counts
