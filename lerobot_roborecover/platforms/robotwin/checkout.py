"""A RoboTwin checkout on disk: where it is, what is in it, and which version. Imports none of its code.

RoboTwin is not a package: its `envs` folder runs out of a git checkout, and its assets are downloaded into
`assets/` beside it. Two layouts exist: configurations in `task_config/` (until July 2026) or in
`env_cfg/task_config/`; `envs/_GLOBAL_CONFIGS.py` names the folder as `CONFIGS_PATH`.
"""

from __future__ import annotations

import ast
import hashlib
import os
import re
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from lerobot_roborecover.platforms.robotwin.robot import RobotwinRobot
from lerobot_roborecover.platforms.simulator import SimulatorError

ROOT_VARIABLE = "ROBOTWIN_ROOT"
EMBODIMENT = "aloha-agilex"
"""The two-armed robot of LeRobot's env and of the paper: 6 joints and a gripper an arm."""

ASSETS_REPO = "TianxingChen/RoboTwin2.0"
"""Where RoboTwin keeps its assets on the Hub (its `assets/_download.py`)."""
ASSETS_REVISION = "981c92aa34d8f94d4cff47e0d5bc2f7d4e0af042"
"""The commit that remedies name; `docker/robotwin.Dockerfile` has its archives' hashes, too."""

_HINT = (
    "Clone https://github.com/RoboTwin-Platform/RoboTwin, download its assets, and name the checkout with "
    f"--env.robotwin_root=<folder> or {ROOT_VARIABLE}"
)
_DECISIVE_METHODS = frozenset(
    {
        "_init_task_env_",
        "check_stable",
        "setup_scene",
        "create_table_and_wall",
        "get_cluttered_table",
        "load_robot",
        "load_camera",
        "set_gripper",
        "together_open_gripper",
        "together_close_gripper",
        "take_dense_action",
        "take_action",
    }
)
"""Methods of `Base_Task` that decide the physics; the others save data and plan for the scripted expert."""


class RobotwinCheckout:
    """A checkout, checked to be one.

    Args:
        root: the folder; None or empty takes `$ROBOTWIN_ROOT`.

    Raises:
        SimulatorError: no folder is named, or it is not a RoboTwin checkout.
    """

    def __init__(self, root: str | os.PathLike[str] | None = None):
        named = str(root or os.environ.get(ROOT_VARIABLE, ""))
        if not named:
            raise SimulatorError(f"no RoboTwin checkout is named. {_HINT}")
        self.root = Path(named).expanduser().resolve()
        if not self.root.is_dir():
            raise SimulatorError(f"RoboTwin checkout {self.root} is not a folder. {_HINT}")
        globals_file = self.root / "envs" / "_GLOBAL_CONFIGS.py"
        if not globals_file.is_file():
            raise SimulatorError(
                f"{self.root} is not a RoboTwin checkout: it has no envs/_GLOBAL_CONFIGS.py. {_HINT}"
            )
        self.configs = self.root / _configs_path(globals_file)
        if not (self.configs / "_eval_step_limit.yml").is_file():
            raise SimulatorError(
                f"{globals_file} says that configurations are in {self.configs}, but there is no "
                "_eval_step_limit.yml there: the working tree is incomplete (git -C "
                f"{self.root} checkout .)"
            )

    @cached_property
    def step_limits(self) -> dict[str, int]:
        """S of every task that this checkout has code for: RoboTwin's official evaluation limits."""
        limits = self.config("_eval_step_limit")
        return {name: int(limit) for name, limit in limits.items() if self.task_file(name).is_file()}

    @cached_property
    def task_configs(self) -> list[str]:
        """Names of the task configurations (`demo_clean`, `demo_randomized`): RoboTwin's suites here."""
        return sorted(p.stem for p in self.configs.glob("*.yml") if not p.stem.startswith("_"))

    def task_file(self, task: str) -> Path:
        return self.root / "envs" / f"{task}.py"

    def config(self, name: str) -> dict[str, Any]:
        """One of the checkout's YAML configurations.

        Raises:
            SimulatorError: it is missing or not a mapping.
        """
        path = self.configs / f"{name}.yml"
        try:
            loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise SimulatorError(f"the RoboTwin checkout has no {path}; it has {self.task_configs}") from None
        if not isinstance(loaded, dict):
            raise SimulatorError(f"{path} does not hold a mapping")
        return loaded

    @cached_property
    def embodiment(self) -> Path:
        """Folder of the robot.

        Raises:
            SimulatorError: the embodiment archive was not downloaded.
        """
        entry = self.config("_embodiment_config").get(EMBODIMENT, {})
        folder = (self.root / entry.get("file_path", f"assets/embodiments/{EMBODIMENT}")).resolve()
        if not (folder / "config.yml").is_file():
            raise SimulatorError(
                f"RoboTwin's robot is missing: no {folder / 'config.yml'}. Download it: "
                + self.download_command("embodiments")
            )
        return folder

    def download_command(self, archive: str) -> str:
        """Shell command that fetches one of RoboTwin's asset archives.

        Not RoboTwin's own `_download_assets.sh`: it passes an argument that the huggingface_hub of this
        LeRobot does not know, and fetches 11 GB of background textures as well.

        Args:
            archive: `embodiments`, `objects` or `background_texture`.
        """
        return (
            f"cd {self.root / 'assets'} && hf download {ASSETS_REPO} {archive}.zip --repo-type dataset "
            f"--revision {ASSETS_REVISION} --local-dir . && unzip -q {archive}.zip && rm {archive}.zip"
        )

    def missing_objects(self, task: str) -> list[str]:
        """Object models that the task's code names and `assets/objects` lacks.

        RoboTwin's models are folders named like `039_mug`; a task without any uses primitive shapes only.
        """
        named = set(re.findall(r'"(\d{3}_[A-Za-z0-9_-]+)"', self.task_file(task).read_text(encoding="utf-8")))
        return sorted(name for name in named if not (self.root / "assets" / "objects" / name).is_dir())

    @cached_property
    def commit(self) -> str:
        """Commit of the checkout; empty where it was not cloned with git."""
        git = self.root / ".git"
        if git.is_file():  # a work tree of another repository
            git = (self.root / git.read_text().removeprefix("gitdir:").strip()).resolve()
        try:
            head = (git / "HEAD").read_text().strip()
        except OSError:
            return ""
        if not head.startswith("ref: "):
            return head
        name = head.removeprefix("ref: ")
        common = git / "commondir"
        base = (git / common.read_text().strip()).resolve() if common.is_file() else git
        if (base / name).is_file():
            return (base / name).read_text().strip()
        packed = base / "packed-refs"
        lines = packed.read_text().splitlines() if packed.is_file() else []
        return next((line.split()[0] for line in lines if line.endswith(f" {name}")), "")

    @cached_property
    def code_hash(self) -> str:
        """Hash of the code that decides the physics of all tasks; commits that differ elsewhere share it."""
        envs = self.root / "envs"
        digest = hashlib.sha256(_decisive_source(envs / "_base_task.py").encode())
        for file in sorted([*envs.glob("robot/*.py"), *envs.glob("utils/*create*.py")]):
            digest.update(file.name.encode() + file.read_bytes())
        return digest.hexdigest()[:16]

    def task_hash(self, task: str) -> str:
        """Hash of one task's own code."""
        return hashlib.sha256(self.task_file(task).read_bytes()).hexdigest()[:16]

    @cached_property
    def robot_hash(self) -> str:
        """Hash of what of the robot collides, moves or is controlled: its URDF, configuration and collision
        meshes."""
        config = self.embodiment / "config.yml"
        urdf = self.embodiment / str(yaml.safe_load(config.read_text())["urdf_path"])
        digest = hashlib.sha256(config.read_bytes() + urdf.read_bytes())
        for block in re.findall(r"<collision.*?</collision>", urdf.read_text(), re.DOTALL):
            for name in re.findall(r'filename="([^"]+)"', block):
                mesh = (urdf.parent / name.removeprefix("package://")).resolve()
                digest.update(mesh.read_bytes() if mesh.is_file() else b"missing")
        return digest.hexdigest()[:16]

    @cached_property
    def robot(self) -> RobotwinRobot:
        """The robot, from the files of its embodiment."""
        return RobotwinRobot(self.embodiment)

    def hashes(self, task: str) -> dict[str, str]:
        """What of the checkout decides a task's physics, under the names a fingerprint gives them."""
        return {
            "robotwin_code": self.code_hash,
            f"robotwin_task.{task}": self.task_hash(task),
            **self.robot.fingerprint,
        }


def _configs_path(globals_file: Path) -> str:
    """The folder that `CONFIGS_PATH` joins to the root."""
    source = globals_file.read_text(encoding="utf-8")
    match = re.search(r'CONFIGS_PATH\s*=\s*os\.path\.join\(ROOT_PATH,\s*"([^"]+)"\)', source)
    if match is None:
        raise SimulatorError(
            f"{globals_file} does not define CONFIGS_PATH as a folder below ROOT_PATH; this version of "
            "RoboTwin is not supported"
        )
    return match[1]


def _decisive_source(base_task: Path) -> str:
    """Source text of the methods in `_DECISIVE_METHODS`."""
    if not base_task.is_file():
        return ""
    text = base_task.read_text(encoding="utf-8")
    methods = [
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef) and node.name in _DECISIVE_METHODS
    ]
    return "\n".join(ast.get_source_segment(text, node) or "" for node in methods)
