"""The plan of a comparison on a robot: points, policies, repeats, blocks and seed, written down and locked.

    points: outputs/points
    policies:
      act: {path: outputs/act}
      pi: {path: me/pi05_cube, overrides: ["--n_action_steps=10"]}
    repeats: 3
    seed: 7

Each block holds every policy once on each of its points, in random order, so that drifting light, a warming
motor or a tiring person meets all policies alike. People see codes; the order is drawn from the plan's hash
and seed. A plan that was begun cannot be changed: `plan.lock.json` in the run's folder holds it.
"""

from __future__ import annotations

import hashlib
import json
import string
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lerobot_roborecover.errors import MAX_SEED, OptionError
from lerobot_roborecover.evaluation.early_checks import check_policy_options
from lerobot_roborecover.policies.identity import policy_identity
from lerobot_roborecover.robot.approach import MotionConfig
from lerobot_roborecover.robot.points import PointSet, read_points
from lerobot_roborecover.robot.start_check import Tolerance
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write

LOCK_FILE = "plan.lock.json"
SCHEMA_VERSION = 1
MAX_POLICIES = 26
MAX_REPEATS = 1000


@dataclass(frozen=True)
class PlannedPolicy:
    path: str
    """Checkpoint folder or Hub id."""
    overrides: tuple[str, ...] = ()
    """Overrides of its configuration, e.g. `--n_action_steps=10`."""
    rename_map: Mapping[str, str] = field(default_factory=dict)
    """The robot's observation keys to the policy's."""


@dataclass(frozen=True)
class Plan:
    """What is compared; everything that can change a result."""

    points: str
    """Folder of the recovery points."""
    policies: Mapping[str, PlannedPolicy]
    """Policies by the name that a report shows."""
    repeats: int = 1
    """Trials of each policy on each point: so many blocks."""
    seed: int = 0
    select: tuple[str, ...] = ()
    """Ids of points; none takes all."""
    tolerance: Tolerance = field(default_factory=Tolerance)
    motion: MotionConfig = field(default_factory=MotionConfig)


@dataclass(frozen=True)
class PlannedTrial:
    """One trial, in the order in which it is run."""

    order: int
    block: int
    point: str
    policy: str
    """Name in the plan; people see `code`."""
    code: str
    trial: int
    """k: index of the trial of this policy on this point."""


@dataclass(frozen=True)
class LockedPlan:
    """A plan whose order is drawn."""

    plan: Plan
    sha256: str
    """Sha256 of the plan, the points and the policies' files."""
    identities: Mapping[str, str]
    """Identities by policy's name: what trial rows call it."""
    codes: Mapping[str, str]
    trials: tuple[PlannedTrial, ...]


def read_plan(path: Path) -> Plan:
    """Reads a plan file.

    Raises:
        OptionError: names the field, the value and what it may be.
    """
    try:
        found = yaml.safe_load(path.read_text("utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as err:
        raise OptionError(f"{path} is not YAML: {' '.join(str(err).split())[:200]}") from None
    if not isinstance(found, dict):
        raise OptionError(f"{path}: a plan is a mapping with points and policies")
    return parse_plan(found, str(path))


def parse_plan(found: Mapping[str, Any], where: str = "plan") -> Plan:
    """A plan of plain values.

    Raises:
        OptionError: names the field, the value and what it may be.
    """
    known = set(Plan.__dataclass_fields__)
    if odd := sorted(set(found) - known):
        raise OptionError(f"{where}: field {odd[0]!r:.60} is not one of {', '.join(sorted(known))}")
    policies = found.get("policies")
    if not isinstance(found.get("points"), str) or not isinstance(policies, dict) or not policies:
        raise OptionError(f"{where}: fields points (a folder) and policies (NAME: {{path: ...}}) are needed")
    if len(policies) > MAX_POLICIES:
        raise OptionError(f"{where}: {len(policies)} policies; the limit is {MAX_POLICIES}")
    try:
        plan = Plan(
            points=found["points"],
            policies={str(n): _policy(n, p) for n, p in policies.items()},
            repeats=found.get("repeats", 1),
            seed=found.get("seed", 0),
            select=tuple(map(str, found.get("select", ()))),
            tolerance=_numbers(Tolerance, found.get("tolerance", {})),
            motion=_numbers(MotionConfig, found.get("motion", {})),
        )
    except (TypeError, ValueError) as err:
        raise OptionError(f"{where}: {' '.join(str(err).split())[:300]}") from None
    for name, value, limit in (("repeats", plan.repeats, MAX_REPEATS), ("seed", plan.seed, MAX_SEED - 1)):
        if type(value) is not int or not (name == "repeats") <= value <= limit:
            raise OptionError(f"{where}: field {name}: {value!r:.40} is not a whole number up to {limit}")
    return plan


def _policy(name: object, values: object) -> PlannedPolicy:
    given: Any = {"path": values} if isinstance(values, str) else values
    if not isinstance(given, dict) or not isinstance(given.get("path"), str):
        raise ValueError(f"policy {name!r:.40}: its path is needed")
    return PlannedPolicy(
        given["path"],
        tuple(map(str, given.get("overrides", ()))),
        {str(k): str(v) for k, v in given.get("rename_map", {}).items()},
    )


def _numbers[C](kind: type[C], values: Mapping[str, Any]) -> C:
    default = kind()
    for name, value in values.items():
        if not hasattr(default, name):
            raise ValueError(f"{kind.__name__} has no {name!r:.40}")
        number = isinstance(getattr(default, name), float)
        if number and (type(value) not in (int, float) or not 0 <= value <= 1e6):
            raise ValueError(f"field {name}: {value!r:.40} is not a number from 0")
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def check_policies(plan: Plan) -> None:
    """Refuses checkpoints that cannot be loaded, and overrides that their policies do not have.

    Raises:
        OptionError: names the policy, what is wrong with it, and the nearest that there is.
    """
    for name, policy in plan.policies.items():
        try:
            check_policy_options(policy.path, policy.overrides)
        except OptionError as err:
            raise OptionError(f"plan: policy {name!r:.40}: {err}") from None


def lock_plan(plan: Plan, folder: Path) -> tuple[LockedPlan, PointSet]:
    """Draws the order and locks the plan in a run's folder; a locked one must be the same.

    Args:
        plan: what to compare.
        folder: of the run; made if need be.

    Raises:
        OptionError: the folder holds another plan, points or policies have changed since, or a policy of a
            plan that is not locked yet cannot be loaded.
        ScenarioError: the points cannot be read.
    """
    points = read_points(plan.points, plan.select)
    if not points.points:
        raise ScenarioError(f"{plan.points} has no points")
    identities = {name: policy_identity(p.path) for name, p in plan.policies.items()}
    content = {
        "plan": json.loads(json.dumps(asdict(plan))),
        "points": {p.id: p.scenario.sha256() for p in points.points},
        "policies": identities,
    }
    sha256 = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    path = folder / LOCK_FILE
    if path.is_file():
        locked = json.loads(path.read_text("utf-8"))
        if locked["sha256"] != sha256:
            changed = [k for k in content if content[k] != locked["content"].get(k)]
            raise OptionError(
                f"{path}: the plan was locked when the run began; its {' and '.join(changed) or 'content'}"
                " changed since. Go on with the plan as it was, or begin a run in another folder"
            )
    else:
        check_policies(plan)
        folder.mkdir(parents=True, exist_ok=True)
        document = {"schema_version": SCHEMA_VERSION, "sha256": sha256, "content": content}
        atomic_write(path, json.dumps(document, indent=1, ensure_ascii=False) + "\n")
    return _drawn(plan, points, sha256, identities), points


def _drawn(plan: Plan, points: PointSet, sha256: str, identities: Mapping[str, str]) -> LockedPlan:
    rng = np.random.default_rng([plan.seed, int(sha256[:8], 16)])
    names = list(plan.policies)
    letters = rng.permutation(list(string.ascii_uppercase[: len(names)])).tolist()
    codes = dict(zip(names, letters, strict=True))
    trials: list[PlannedTrial] = []
    for block in range(plan.repeats):
        pairs = [(point.id, name) for point in points.points for name in names]
        for index in rng.permutation(len(pairs)):
            point, name = pairs[index]
            trials.append(PlannedTrial(len(trials), block, point, name, codes[name], block))
    return LockedPlan(plan, sha256, identities, codes, tuple(trials))
