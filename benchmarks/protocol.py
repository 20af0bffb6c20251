"""The protocol's numbers for every scenario of a set: is the handoff the recorded one, and what does it cost?

    python benchmarks/protocol.py --set libero_starter
    python benchmarks/protocol.py --set metaworld_study --steps 50

For each scenario: a handoff by replay, one from the snapshot that it left, and steps without rendering after
it, in one process. No policy: actions are zero.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterable

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.platforms.simulator import Simulator
from lerobot_roborecover.replay.handoff import SnapshotCache, hand_off
from lerobot_roborecover.scenario import Scenario


def measure(simulator: Simulator, scenario: Scenario, cache: SnapshotCache, steps: int) -> dict[str, float]:
    """One scenario's numbers: errors in millimetres, times in seconds."""
    import numpy as np  # after lerobot_roborecover, which pins how it rounds (docs/log/exactness.md)

    replay = hand_off(simulator, scenario, cache=cache)
    again = hand_off(simulator, scenario, cache=cache)
    idle = np.zeros(scenario.prefix.shape[1], scenario.prefix.dtype)
    began = time.perf_counter()
    for _ in range(steps):
        simulator.step(idle)
    return {
        "eef mm": replay.eef_error_mm or 0.0,
        "object mm": replay.object_error_mm or 0.0,
        "identical": bool(replay.identical),
        "snapshot alike": again.from_snapshot and again.state_sha256 == replay.state_sha256,
        "prefix": len(scenario.prefix),
        "replay s": replay.seconds,
        "snapshot s": again.seconds,
        "steps/s": steps / (time.perf_counter() - began),
    }


def line(label: str, found: Iterable[dict[str, float]]) -> str:
    """A table row: counts, largest errors, medians."""
    rows = list(found)
    middle = {
        k: statistics.median(r[k] for r in rows) for k in ("prefix", "replay s", "snapshot s", "steps/s")
    }
    return (
        f"| {label} | {len(rows)} | {sum(r['identical'] for r in rows)} | "
        f"{sum(r['snapshot alike'] for r in rows)} | {max(r['eef mm'] for r in rows):.3g} | "
        f"{max(r['object mm'] for r in rows):.3g} | {middle['prefix']:.0f} | {middle['replay s']:.2f} | "
        f"{middle['snapshot s']:.3f} | {middle['steps/s']:.0f} |"
    )


def main() -> None:
    """Prints a row for each suite, and one for all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--set", default="libero_starter", help="name, folder or Hub id (%(default)s)")
    parser.add_argument("--steps", type=int, default=30, help="after the handoff (%(default)s)")
    args = parser.parse_args()
    scenarios = sorted(load_scenarios(args.set), key=lambda s: (s.task.suite, s.task.name, s.id))
    simulator, cache = make_simulator(scenarios[0].platform, obs_type="state"), SnapshotCache()
    print(
        "| suite | scenarios | identical state | snapshot alike | largest eef error, mm | object error, mm | "
        "prefix | replay, s | snapshot, s | steps/s |\n" + "|---" * 10 + "|"
    )
    found: dict[str, list[dict[str, float]]] = {}
    for scenario in scenarios:
        found.setdefault(scenario.task.suite, []).append(measure(simulator, scenario, cache, args.steps))
    for suite, rows in found.items():
        print(line(suite, rows))
    print(line("all", [row for rows in found.values() for row in rows]))
    simulator.close()


if __name__ == "__main__":
    main()
