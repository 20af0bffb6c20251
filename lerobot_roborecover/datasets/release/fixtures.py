"""Where the release's reset puts LIBERO's fixtures: what tells a wrong seed or version, which no record does.

LIBERO draws the poses of cabinets, stoves, racks, microwaves and caddies at every reset, and its init states
lack them. A record says where the robot was, so that another seed passes for the right one while a fixture is
2 to 26 mm off. The release resets with one seed, 7, so that the poses are known for every task: they are
package data, recorded here with the versions that the paper's runs used.

    python -m lerobot_roborecover.datasets.release.fixtures    # records them again
"""

from __future__ import annotations

import importlib.resources
import json
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lerobot_roborecover.datasets.release.record import LIBERO_SEED
from lerobot_roborecover.platforms.simulator import Simulator
from lerobot_roborecover.scenario import Pose, Reset, Scenario, ScenarioError, Task

_FILE = "data/release/libero_fixtures.json"
SCHEMA_VERSION = 1
LIMIT_MM = 0.1
LIMIT_RAD = 1e-3
"""Poses that are drawn come out the same to the last digit, with the same versions: this leaves room for
nothing but rounding. Seeds differ by 2 mm and more."""


@cache
def released_fixtures() -> dict[tuple[str, str], dict[str, Pose]]:
    """Fixture poses after the release's reset by suite and task name; tasks without fixtures are left out."""
    text = (importlib.resources.files("lerobot_roborecover") / _FILE).read_text(encoding="utf-8")
    found = {}
    for name, poses in json.loads(text)["tasks"].items():
        suite, task = name.split("/", 1)
        found[suite, task] = {n: Pose.of(p) for n, p in poses.items()}
    return found


def check_fixtures(simulator: Simulator, scenario: Scenario) -> dict[str, float]:
    """Measures how far the fixtures of a simulator, just reset, are from where the scenario's seed puts them.

    With the release's seed that is where the package data has them. With another one they are compared if the
    scenario was replayed before: with what the seed draws here, now.

    Args:
        simulator: reset to the scenario, and left so.
        scenario: of LIBERO.

    Returns:
        `fixture_mm` and `fixture_rad`, the largest; empty where there is nothing to compare with.

    Raises:
        ScenarioError: names the fixture that is off, and by how much.
    """
    found = simulator.fixtures()
    if scenario.reset.seed == LIBERO_SEED:
        said = released_fixtures().get((scenario.task.suite, scenario.task.name), {})
        whose = f"the release's reset, env.seed({LIBERO_SEED}), puts it"
    elif scenario.reset.fixtures:
        simulator.reset(scenario.task, _without_fixtures(scenario.reset))
        said = simulator.fixtures()
        simulator.reset(scenario.task, scenario.reset)
        whose = f"seed {scenario.reset.seed} puts it here"
    else:
        return {}
    return compare_fixtures(found, said, whose)


def compare_fixtures(found: Mapping[str, Pose], said: Mapping[str, Pose], whose: str) -> dict[str, float]:
    """Largest distance and angle between fixture poses of the same names.

    Args:
        found: poses by body name.
        said: what they are compared with.
        whose: says what `said` is, for the message.

    Raises:
        ScenarioError: names the fixture that is off, and by how much.
    """
    if set(found) != set(said):
        raise ScenarioError(
            f"the reset has the fixtures {sorted(found)}, but {sorted(said)} are where {whose}; compare "
            "versions and assets (roborecover doctor)"
        )
    worst = {"fixture_mm": 0.0, "fixture_rad": 0.0}
    for name, pose in found.items():
        off_mm, off_rad = pose.distance_m(said[name]) * 1e3, angle_rad(pose.quat_xyzw, said[name].quat_xyzw)
        if not (off_mm <= LIMIT_MM and off_rad <= LIMIT_RAD):
            raise ScenarioError(
                f"fixture {name} is {off_mm:.3g} mm and {off_rad:.3g} rad from where {whose} (limits "
                f"{LIMIT_MM:g} mm, {LIMIT_RAD:g} rad); compare versions and assets (roborecover doctor), and "
                "the seed"
            )
        worst = {
            "fixture_mm": max(worst["fixture_mm"], off_mm),
            "fixture_rad": max(worst["fixture_rad"], off_rad),
        }
    return worst


def angle_rad(found: ArrayLike, said: ArrayLike) -> float:
    """Angle between two rotations given as quaternions of the same order."""
    a, b = (np.asarray(q, dtype=np.float64) for q in (found, said))
    a, b = a / max(float(np.linalg.norm(a)), 1e-12), b / max(float(np.linalg.norm(b)), 1e-12)
    # Between two unit vectors this is exact near zero, where arccos is not.
    return float(4 * np.arcsin(min(np.linalg.norm(a - b), np.linalg.norm(a + b)) / 2))


def _without_fixtures(reset: Reset) -> Reset:
    return Reset(seed=reset.seed, init_state_index=reset.init_state_index, settle_steps=reset.settle_steps)


def record_fixtures() -> dict[str, Any]:
    """Resets every task as the release does, and returns what the data file holds."""
    from lerobot_roborecover.platforms import make_simulator
    from lerobot_roborecover.platforms.libero.catalog import LIBERO_HORIZONS, libero_instruction, libero_tasks

    simulator = make_simulator("libero", obs_type="state")
    tasks = {}
    try:
        for suite, names in libero_tasks().items():
            for name in names:
                task = Task("libero", suite, name, libero_instruction(name), LIBERO_HORIZONS[suite])
                simulator.reset(task, Reset(seed=LIBERO_SEED, init_state_index=0))
                if poses := simulator.fixtures():
                    tasks[f"{suite}/{name}"] = {
                        n: [*p.position_m, *p.quat_xyzw] for n, p in sorted(poses.items())
                    }
        versions = simulator.fingerprint()
    finally:
        simulator.close()
    return {
        "schema_version": SCHEMA_VERSION,
        "seed": LIBERO_SEED,
        "versions": {k: v for k, v in versions.items() if k != "libero_assets"},
        "poses": "position in metres, quaternion xyzw",
        "tasks": tasks,
    }


if __name__ == "__main__":
    from pathlib import Path

    from lerobot_roborecover.utils.atomic_io import atomic_write

    place = Path(str(importlib.resources.files("lerobot_roborecover"))) / _FILE
    atomic_write(place, json.dumps(record_fixtures(), indent=1) + "\n")
    print(place)
