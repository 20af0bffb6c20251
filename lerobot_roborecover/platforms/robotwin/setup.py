"""What surrounds a RoboTwin task's own code: importing it, its arguments, and the names of what it made."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import sys
from collections.abc import Generator
from copy import deepcopy
from typing import TYPE_CHECKING, Any

import yaml

from lerobot_roborecover.platforms.robotwin import stubs
from lerobot_roborecover.platforms.robotwin.checkout import EMBODIMENT, RobotwinCheckout
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.utils.text import install_command

if TYPE_CHECKING:
    from sapien import Entity

type TaskCode = Any
"""A task of RoboTwin's own code, which has no types and is not installed as a package."""

_ARMS = "left_entity", "right_entity"


def import_task(checkout: RobotwinCheckout, name: str) -> type:
    """RoboTwin's class of a task; its code stays in `sys.modules`, so a process serves one checkout."""
    loaded = sys.modules.get("envs")
    expected = checkout.root / "envs"
    if loaded is not None and str(expected) not in [os.path.realpath(p) for p in loaded.__path__]:
        raise SimulatorError(
            f"this process has already imported `envs` from {list(loaded.__path__)}; it cannot use the "
            f"RoboTwin checkout {checkout.root} as well. Use a worker process (--eval.use_async_envs=true)"
        )
    stubs.install()
    sys.path.insert(0, str(checkout.root))
    try:
        with quiet():
            module = importlib.import_module(f"envs.{name}")
    except ImportError as err:
        raise SimulatorError(
            f"RoboTwin's code cannot be imported ({err}). Install what it needs: "
            f"{install_command('robotwin')}"
        ) from err
    finally:
        sys.path.remove(str(checkout.root))
    return getattr(module, name)


def setup_arguments(checkout: RobotwinCheckout, task: str, task_config: str) -> dict[str, Any]:
    """What RoboTwin's own evaluation script passes to `setup_demo`."""
    arguments = deepcopy(checkout.config(task_config))
    embodiment = arguments.get("embodiment", [EMBODIMENT])
    if embodiment != [EMBODIMENT]:
        raise SimulatorError(
            f"RoboTwin configuration {task_config} uses the embodiment {embodiment}; only [{EMBODIMENT}], "
            "with 14 joint values, is supported"
        )
    robot = yaml.safe_load((checkout.embodiment / "config.yml").read_text(encoding="utf-8"))
    camera = checkout.config("_camera_config")[arguments["camera"]["head_camera_type"]]
    arguments.update(
        task_name=task,
        task_config=task_config,
        eval_mode=True,
        render_freq=0,
        save_data=False,
        dual_arm_embodied=True,
        left_robot_file=str(checkout.embodiment),
        right_robot_file=str(checkout.embodiment),
        left_embodiment_config=deepcopy(robot),
        right_embodiment_config=deepcopy(robot),
        head_camera_h=camera["h"],
        head_camera_w=camera["w"],
        data_type={"rgb": True, "qpos": True, "endpose": True},
    )
    return arguments


def body_names(task: TaskCode) -> dict[Entity, str]:
    """Movable entities and articulation links of the scene that are not the robot's, by a name of their own.

    Named as the task's code names them (`block1`), because RoboTwin's entity names repeat.
    """
    robots = {id(link) for side in _ARMS for link in getattr(task.robot, side).get_links()}
    robot_entities = {link.entity for side in _ARMS for link in getattr(task.robot, side).get_links()}
    attributes = {}
    for attribute, value in vars(task).items():
        actor = getattr(value, "actor", value)
        if type(actor).__name__ in ("Entity", "PhysxArticulation"):
            attributes.setdefault(actor, attribute)
    physics = task.scene.physx_system
    found: list[tuple[Entity, str]] = []
    for component in physics.rigid_dynamic_components:
        if not getattr(component, "kinematic", False):
            found.append((component.entity, attributes.get(component.entity) or component.entity.name))
    for link in physics.articulation_link_components:
        if id(link) in robots or link.entity in robot_entities or link.is_root:
            continue
        owner = attributes.get(link.articulation) or link.articulation.name or "articulation"
        found.append((link.entity, f"{owner}.{link.name}"))
    names: dict[Entity, str] = {}
    for entity, name in found:
        unique, copy = name or "body", 2
        while unique in names.values() or unique.startswith("eef"):
            unique, copy = f"{name or 'body'}.{copy}", copy + 1
        names[entity] = unique
    return names


def mend(task: TaskCode, name: str) -> None:
    """Sets what `check_success` reads and only the scripted expert `play_once` would set.

    Each value is what the expert's first lines compute from the scene at rest; RoboTwin's own evaluation has
    them because it runs the expert on every seed before the policy.
    """
    if name == "open_laptop":
        rotation = task.laptop.get_pose().to_transformation_matrix()
        task.arm_tag = "left" if rotation[0, 0] > 0 else "right"
    elif name in ("place_object_scale", "put_object_cabinet"):
        position = task.object.get_pose().p
        task.arm_tag = "right" if position[0] > 0 else "left"
        if name == "put_object_cabinet":
            task.origin_z = position[2]


def without_objects(checkout: RobotwinCheckout) -> list[str]:
    """Tasks that this checkout can run with the object models it has."""
    return [name for name in checkout.step_limits if not checkout.missing_objects(name)]


@contextlib.contextmanager
def working_in(root: os.PathLike[str]) -> Generator[None]:
    """Another working directory within: RoboTwin's code opens its files relative to the checkout."""
    before = os.getcwd()
    os.chdir(root)
    try:
        yield
    finally:
        os.chdir(before)


@contextlib.contextmanager
def quiet() -> Generator[None]:
    """Swallows RoboTwin's progress output, one line an action."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
