"""How often policies solve LIBERO's tasks from their starts, from what `curate collect` has rolled out.

    P=policies/libero/act
    roborecover curate collect --env.type=roborecover_libero --env.obs_type=state --policy.path=$P \\
      --name act --task 'libero_*' --init-states 0,12 --frames none --out natural/act
    python -m recipes.libero.initial_success natural/*.work
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

from lerobot_roborecover.curation.collect.rollouts import ROLLOUTS_FILE, SCHEMA_VERSION
from lerobot_roborecover.platforms.libero.platform import PLATFORM
from lerobot_roborecover.utils.journal import Journal

type Counts = Mapping[str, Mapping[str, tuple[int, int]]]
"""Solved and tried rollouts by policy and suite."""


def count(folders: Iterable[Path]) -> Counts:
    """Reads working folders of collections, `NAME-...work` each of the policy NAME."""
    found: dict[str, dict[str, tuple[int, int]]] = defaultdict(dict)
    suites = {PLATFORM.short_name(task).split("-")[0]: task.suite for task in PLATFORM.tasks()}
    for folder in folders:
        name = folder.name.removesuffix(".work").split("-")[0]
        journal = Journal(folder / ROLLOUTS_FILE, SCHEMA_VERSION)
        for row in journal.records:
            suite = suites[row["rollout"].split("-")[0]]
            solved, tried = found[name].get(suite, (0, 0))
            found[name][suite] = solved + (row["outcome"] == "success"), tried + 1
        journal.close()
    return found


def table(counts: Counts) -> str:
    """Markdown: a row a suite, a column a policy, and all together."""
    suites = list(dict.fromkeys(suite for by_suite in counts.values() for suite in by_suite))
    lines = [
        "| suite | " + " | ".join(f"`{name}`" for name in counts) + " |",
        "|---" * (len(counts) + 1) + "|",
    ]
    for suite in sorted(suites):
        cells = ["{}/{}".format(*by_suite.get(suite, (0, 0))) for by_suite in counts.values()]
        lines.append(f"| {suite} | " + " | ".join(cells) + " |")
    shares = []
    for by_suite in counts.values():
        solved, tried = (sum(values) for values in zip(*by_suite.values(), strict=True))
        shares.append(f"{100 * solved / tried:.0f} %")
    lines.append("| all | " + " | ".join(shares) + " |")
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path, nargs="+", help="working folders of collections")
    print(table(count(parser.parse_args().work)))


if __name__ == "__main__":
    main()
