"""Platform interface: everything about a simulator family but the physics. Other code uses only this.

A platform is one subclass of `Platform` and one `Simulator`. Ours lie in the folders beside this file; those
of other distributions are found through the entry-point group `roborecover.platforms` (docs/platforms.md).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms.catalog import TaskCatalog
from lerobot_roborecover.platforms.simulator import Simulator, SimulatorError
from lerobot_roborecover.scenario import Reset, ScenarioError, Task
from lerobot_roborecover.utils.text import install_command

if TYPE_CHECKING:
    from lerobot_roborecover.platforms.controls import Controls
    from lerobot_roborecover.platforms.findings import Check
    from lerobot_roborecover.platforms.starts import Starts

type Controller = Callable[[int], np.ndarray]
"""Next action, (A,) float64, for the given step; reads the simulator's present state."""


@dataclass(frozen=True)
class Expert:
    """A scripted controller, for `roborecover curate collect --expert`."""

    make: Callable[[Any, Task, np.random.Generator], Controller]
    """From a simulator that was reset and has settled, the task, and the random stream of controllers that
    draw."""
    about: str
    """A few words for a list of choices."""


@dataclass(frozen=True)
class SimulatorSetup:
    """Simulator options from a checked env config, and those of them that decide results."""

    options: Mapping[str, Any]
    """Keyword options of the simulator; plain JSON values, because they travel to worker processes."""
    decisive: Mapping[str, Any]
    """Those that decide a result, for the trial rows."""
    picture: Callable[[dict], np.ndarray] | None = None
    """Upright frame (H, W, 3) uint8 of an observation, for LeRobot's videos; None asks the simulator."""
    assets: Mapping[str, str] = field(default_factory=dict)
    """Hashes of assets that decide the physics, under the names a fingerprint gives them."""
    control_mode: str | None = None
    """How actions after the handoff are read, for simulators that have more than one way."""
    approximate_snapshots: bool = False
    """Use snapshots also where what follows them drifts from a replay."""
    platform: str = ""
    """Name of the platform, where the env type serves several."""
    video_options: Mapping[str, Any] = field(default_factory=dict)
    """Options in place of those above where pictures are drawn for videos alone."""


class VideoEnvMixin:
    """A platform's env config, as far as recovery evaluation decides it where the env type is registered."""

    videos: bool
    """Render frames for LeRobot's videos also where the observation has no pixels (`RecoveryOptions`)."""


class Platform(TaskCatalog):
    """One simulator family. Subclass it, set the attributes, and override what the defaults do not fit.

    Nothing here imports a simulator, LeRobot or torch before it is asked for: the list of platforms is read
    by every command and by every worker process.
    """

    name: ClassVar[str]
    """Lower-case; the env type is `roborecover_<name>`, the Gymnasium id `roborecover/<Name>-v0`."""
    title: ClassVar[str]
    """Display name, e.g. `LIBERO`."""
    action_widths: ClassVar[tuple[int, ...]]
    """Values in a recorded action; more than one where the platform has several kinds of actions."""
    control_hz: ClassVar[float]
    """Control steps a second."""
    action_bound: ClassVar[float] = 1.0
    """Largest |value| of an action that the simulator does not cut; infinite for joint targets."""
    action_names: ClassVar[Mapping[int, tuple[str, ...]]] = {}
    """Display names of an action's values by action width; names that end with `gripper` command grippers."""
    gripper_commands: ClassVar[tuple[float, float]] = (-1.0, 1.0)
    """Values of a gripper's command that open and close it."""
    axis_angle: ClassVar[Mapping[int, tuple[int, ...]]] = {}
    """By width of a policy's state: which values are an axis-angle of robosuite's quaternion."""
    records_control_mode: ClassVar[str | None] = None
    """The env option `control_mode` that recorded actions are of; None where they can be of any."""
    settle_steps: ClassVar[int] = 0
    """Actions at a rollout's start that only let the scene settle; they belong to its prefix."""
    clustered: ClassVar[bool] = False
    """Several scenarios come of one trajectory: statistics resample trajectories, not scenarios."""
    apart: ClassVar[tuple[str, ...]] = ("trajectory", "record")
    """What may not lie on both sides of a split; default of `roborecover curate split`."""
    images_rotated_180: ClassVar[bool] = False
    """Observed pictures leave the simulator rotated by 180 degrees."""
    sizes_pictures: ClassVar[bool] = True
    """`picture_options` decides how large pictures are; elsewhere a task's own configuration does."""
    required_versions: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Distributions on which scores depend, and the versions whose scores can be compared."""
    extra: ClassVar[str] = ""
    """Of the distribution that brings the platform's packages, e.g. `libero`; empty where none is needed."""
    distribution: ClassVar[str] = "lerobot_env_roborecover"
    """What installs the platform."""
    simulated: ClassVar[bool] = True
    """Whether it has a simulator; real robots have none."""
    simulator: ClassVar[str]
    """`module:Class` of the simulator, imported where one is made."""
    default_scenarios: ClassVar[str] = ""
    """Scenario set that the env type takes where none is named: a shipped set, Hub id or folder."""
    default_split: ClassVar[str] = ""
    """The split of the default set that is evaluated where neither a set nor a split is named; empty: all."""
    experts: ClassVar[Mapping[str, Expert]] = {}
    """Scripted controllers by name."""
    perturbable: ClassVar[bool] = True
    """Actions begin with normalised translations that `collect --perturb` can disturb."""
    why_not_perturbable: ClassVar[str] = ""
    perturbation: ClassVar[tuple[float, ...]] = (1.0, 1.0, 1.0)
    """Half-widths of the disturbance of an action's leading values, in their own units: the paper's, of
    normalised translations."""
    env_name: ClassVar[str] = ""
    """The env type is `roborecover_<env_name>`, where that is not the platform's name: one that serves
    several platforms."""
    env_defaults: ClassVar[Mapping[str, Any]] = {}
    """Options of that env type that name this platform, nested as in a configuration file."""
    env_config_class: ClassVar[str] = ""
    """`module:Class` of LeRobot's `EnvConfig` of the platform; see `env_config`."""
    observation_options: ClassVar[tuple[tuple[str, Any], ...]] = (
        ("obs_type", "state"),
        ("obs_type", "pixels_agent_pos"),
    )
    """Env options (name, value) that give a policy other inputs, for the remedy where one is missing."""

    def resolve(self, options: Sequence[str]) -> Platform:
        """The platform that options of the env type choose, where it serves several.

        Args:
            options: `name=value`, as after `--env.`.

        Raises:
            ScenarioError: they name none.
        """
        return self

    def grippers(self, width: int) -> tuple[int, ...]:
        """Which values of an action command grippers.

        Args:
            width: values in an action.
        """
        return tuple(i for i, n in enumerate(self.action_names.get(width, ())) if n.endswith("gripper"))

    def check_width(self, width: int, where: str) -> None:
        """Refuses recorded actions of another width.

        Args:
            width: values in an action.
            where: the beginning of the message.

        Raises:
            ScenarioError: the platform has no actions of this width.
        """
        if width not in self.action_widths:
            raise ScenarioError(
                f"{where}: prefix actions have width {width}; platform {self.name} takes "
                f"{' or '.join(map(str, self.action_widths))}"
            )

    def rewind_steps(self, horizon: int) -> int:
        """Returns the default number of steps that Reversion rolls back (paper, "Intervention Results").

        Args:
            horizon: S of the task.
        """
        return 30

    # --- where rollouts start

    def resets(self, task: Task, starts: Starts) -> list[Reset]:
        """A task's resets, in the order listed or drawn.

        Raises:
            ScenarioError: the platform has other starts, or not as many.
        """
        return starts.by_seed(task, self.settle_steps)

    def first_reset(self, task: Task, seed: int | None = None, init_state: int | None = None) -> Reset:
        """One reset of a task, by default its first.

        Raises:
            ScenarioError: the platform has no init states.
        """
        if init_state is not None:
            raise ScenarioError(f"{self.name} has no init states; its tasks are laid out by a seed")
        return Reset(seed=0 if seed is None else seed)

    def another_reset(self, task: Task, number: int) -> Reset:
        """A reset of a task that differs from the first.

        Args:
            task: whose.
            number: 1 for the second start, and so on.
        """
        return self.first_reset(task, seed=number)

    def random_actions(self, rng: np.random.Generator, steps: int, width: int) -> np.ndarray:
        """Returns (steps, width) float64 harmless actions for `check-platform`."""
        return rng.uniform(-1.0, 1.0, (steps, width)) * min(self.action_bound, 1.0)

    def no_op(self) -> np.ndarray:
        """Returns the (A,) float64 action that keeps the robot still while the scene settles."""
        return np.zeros(self.action_widths[0])

    def unsupported_reason(self, task: Task) -> str:
        """Returns why the scripted controllers cannot do a task; empty where they can try."""
        return ""

    def short_name(self, task: Task) -> str:
        """Returns a short task name for the ids of its rollouts."""
        return task.name

    # --- simulator and observations

    def make_simulator(self, **options: Any) -> Simulator:
        """Makes the simulator.

        Args:
            options: its own keyword options.

        Raises:
            SimulatorError: a package that it needs is not installed, or an option cannot be used.
        """
        module, _, name = self.simulator.partition(":")
        try:
            cls = getattr(importlib.import_module(module), name)
        except ModuleNotFoundError as err:
            raise SimulatorError(
                f"platform {self.name!r} needs the package {err.name!r}, which is not installed. "
                f"Install it with: {self.install_command}"
            ) from err
        return cls(**options)

    def evaluated(self, scenarios: str, split: str | None) -> tuple[str, str | None]:
        """Returns the scenario set and split: as given, or the default set and its default split.

        Raises:
            OptionError: none is given, and there is no default.
        """
        if scenarios:
            return scenarios, split
        if not self.default_scenarios:
            raise OptionError(
                f"--env.scenarios: {self.name} has no shipped scenarios; name a folder or a Hub dataset"
            )
        return self.default_scenarios, split or self.default_split or None

    @property
    def install_command(self) -> str:
        """Command that installs the platform's packages."""
        return install_command(self.extra, self.distribution)

    def action_space(self, width: int) -> gym.spaces.Box:
        """Actions that the simulator accepts.

        Args:
            width: values in an action.
        """
        return gym.spaces.Box(-self.action_bound, self.action_bound, (width,), np.float32)

    def policy_action_width(self, options: Mapping[str, Any], recorded: int) -> int:
        """Values in a policy's action.

        Args:
            options: of the simulator.
            recorded: values in the scenario's recorded actions.
        """
        return recorded

    def picture_options(self, size: int) -> dict[str, Any]:
        """Simulator options for square pictures.

        Args:
            size: side in pixels; 0 for none.
        """
        if not size:
            return {"obs_type": "state"}
        return {"obs_type": "pixels_agent_pos", "observation_height": size, "observation_width": size}

    def upright(self, picture: np.ndarray) -> np.ndarray:
        """An observed picture (H, W, 3) as people, and policies behind LeRobot's processors, see it."""
        return picture[::-1, ::-1] if self.images_rotated_180 else picture

    def process_observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """LeRobot's own processing of the platform's observations, after `preprocess_observation`."""
        return observation

    def gripper_closed(self, state: np.ndarray) -> bool:
        """Whether the gripper is to stay closed when a person takes over, so that the object is not dropped.

        Args:
            state: (D,) `observation.state` of a policy.
        """
        return False

    def owns_observation(self, observation: Mapping[str, tuple[int, ...]]) -> bool:
        """Whether a policy's observation, by the shapes of its entries, is this platform's."""
        return False

    # --- people

    def controls(self) -> Controls:
        """Returns the teleoperation controls.

        Raises:
            ScenarioError: it cannot be driven by hand; says why.
        """
        raise ScenarioError(f"{self.title} cannot be driven by hand: the platform does not define the keys")

    # --- LeRobot

    def env_config(self) -> type:
        """LeRobot's `EnvConfig` of the platform: a dataclass with `simulator_setup() -> SimulatorSetup`,
        which raises `OptionError` for what cannot be used. Imports LeRobot. The options of recovery
        evaluation (`RecoveryOptions`) are added to it where it is registered.

        Set `env_config_class`, or override this; with the former, a wrong option is refused before LeRobot
        is imported."""
        if not self.env_config_class:
            raise NotImplementedError(f"platform {self.name} sets no env_config_class")
        module, _, name = self.env_config_class.partition(":")
        return getattr(importlib.import_module(module), name)

    # --- the machine

    def examine(self, required: bool, recorded: Mapping[str, str]) -> list[Check]:
        """Returns the doctor's checks of what the platform needs beside packages: assets, checkouts.

        Args:
            required: what is missing is a failure rather than a warning.
            recorded: what recorded the platform's shipped set, by name of the package or file
                (`Fingerprint.versions`); empty where there is none to compare with.
        """
        return []

    def environment_fingerprint(self, options: Mapping[str, Any]) -> dict[str, str | None]:
        """Returns other inputs that decide a replay: asset folders from options or environment variables."""
        return {}

    def __repr__(self) -> str:
        return f"<platform {self.name}>"
