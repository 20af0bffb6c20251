"""LeRobot policies on a robot that stays connected: LeRobot's own rollout context, one a policy."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.robot.clock import SteppedClock, clock_of
from lerobot_roborecover.robot.connection import camera_names
from lerobot_roborecover.utils.plugins import register_plugins

_FIRST_ACTION_S = 300.0
"""A large model compiles and loads within this."""


def load_context(
    robot: Any,
    path: str,
    *,
    fps: float,
    instruction: str,
    overrides: Sequence[str] = (),
    rename_map: Mapping[str, str] | None = None,
    inference: Any = None,
) -> Any:
    """LeRobot's `RolloutContext` of a policy on a connected robot.

    Args:
        robot: connected; it stays so.
        path: checkpoint folder or Hub id.
        fps: control steps a second.
        instruction: of the task.
        overrides: of the policy's configuration, e.g. `--n_action_steps=5`.
        rename_map: the robot's observation keys to the policy's.
        inference: a LeRobot `InferenceEngineConfig`; by default synchronous.

    Raises:
        OptionError: the checkpoint cannot be loaded, or needs a camera that the robot does not have.
    """
    from lerobot.configs import FeatureType, PreTrainedConfig
    from lerobot.rollout.configs import RolloutConfig
    from lerobot.rollout.context import build_rollout_context
    from lerobot.rollout.inference import RTCInferenceConfig, SyncInferenceConfig

    from lerobot_roborecover.policies.command_line import plain_output, process_arguments
    from lerobot_roborecover.robot.config_held_robot import HeldRobotConfig

    register_plugins()
    if isinstance(inference, RTCInferenceConfig) and isinstance(clock_of(robot), SteppedClock):
        raise OptionError(
            "--inference.type=rtc: the policy thinks while the robot moves, which takes the wall's time. "
            "Leave --robot.realtime=false out"
        )
    renamed = dict(rename_map or {})
    try:
        with process_arguments("roborecover robot", []), plain_output():
            config = PreTrainedConfig.from_pretrained(path, cli_overrides=list(overrides))
            config.pretrained_path = path  # ty: ignore[invalid-assignment] - LeRobot sets text, too
            provided = {f"observation.images.{name}" for name in camera_names(robot)}
            provided = {renamed.get(key, key) for key in provided}
            wanted = [k for k, f in (config.input_features or {}).items() if f.type is FeatureType.VISUAL]
            if missing := [key for key in wanted if key not in provided]:
                raise OptionError(
                    f"policy {path} needs {missing[0]}; the robot has {', '.join(sorted(provided)) or 'none'}"
                    ". Add the camera to --robot.cameras, or map one to it with rename_map"
                )
            rollout = RolloutConfig(
                robot=HeldRobotConfig(robot=robot),
                policy=config,
                inference=inference or SyncInferenceConfig(),
                fps=fps,
                task=instruction,
                rename_map=renamed,
                return_to_initial_position=False,
                play_sounds=False,
            )
            return build_rollout_context(rollout, threading.Event())
    except (OSError, ValueError, KeyError, NotImplementedError) as err:
        if isinstance(err, OptionError):
            raise
        raise OptionError(f"policy {path} cannot be loaded: {' '.join(str(err).split())[:300]}") from err


def warm_up(context: Any) -> None:
    """Has a policy infer once and throws the action away, so that a trial does not pay for a slow first time.

    Args:
        context: of the policy; its robot is looked at, and does not move.

    Raises:
        OptionError: the policy cannot infer on what the robot observes.
        RobotLostError: the robot does not answer.
    """
    from lerobot.rollout.inference import SyncInferenceEngine
    from lerobot.utils.constants import OBS_STR
    from lerobot.utils.feature_utils import build_dataset_frame

    engine = context.policy.inference
    observation = context.hardware.robot_wrapper.get_observation()
    seen = context.processors.robot_observation_processor(observation)
    engine.reset()
    if isinstance(engine, SyncInferenceEngine):
        try:
            engine.get_action(build_dataset_frame(context.data.dataset_features, seen, prefix=OBS_STR))
        except (RuntimeError, ValueError, KeyError, TypeError) as err:
            raise OptionError(
                "a policy cannot infer on what the robot observes: "
                f"{type(err).__name__}: {' '.join(str(err).split())[:300]}"
            ) from err
    else:
        _warm_up_background(engine, seen)
    engine.reset()


def _warm_up_background(engine: Any, seen: dict[str, Any]) -> None:
    """Waits for the first action of an engine that infers in a thread of its own (RTC)."""
    engine.start()
    try:
        engine.notify_observation(seen)
        engine.resume()
        begun = time.monotonic()
        while engine.get_action(None) is None:
            if engine.failed or time.monotonic() - begun > _FIRST_ACTION_S:
                raise OptionError(
                    f"a policy gave no action within {time.monotonic() - begun:.0f} s on what the robot "
                    "observes; LeRobot's lines above say why. Try it with --inference.type=sync"
                )
            time.sleep(0.01)
    finally:
        engine.stop()


def set_instruction(context: Any, instruction: str) -> None:
    """Gives a policy's engine another instruction; LeRobot's own is fixed where the engine is made."""
    assert hasattr(context.policy.inference, "_task")
    context.policy.inference._task = instruction
