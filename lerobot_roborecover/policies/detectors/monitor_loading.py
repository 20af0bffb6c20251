"""Loads a monitor from a folder or Hub id, whatever its type."""

from __future__ import annotations

import json

from lerobot_roborecover.policies.detectors.monitor.errors import MonitorError
from lerobot_roborecover.policies.detectors.monitor.files import CONFIG_FILE, find_file
from lerobot_roborecover.policies.detectors.monitor_interface import Monitor


def load_monitor(
    path: str, device: str | None = None, revision: str | None = None, **overrides: str
) -> Monitor:
    """Loads a monitor by LeRobot's own registry of reward models.

    Args:
        path: folder or Hub id of a checkpoint.
        device: where it runs; None takes what its config says, or what there is.
        revision: of a Hub id.
        overrides: other values of its config, e.g. `threshold="0.7"` or `base_model=FOLDER`.

    Raises:
        MonitorError: it is not there, is not a monitor, or lacks a part.
    """
    from draccus.utils import DecodingError, ParsingError
    from lerobot.configs.rewards import RewardModelConfig
    from lerobot.rewards import get_reward_model_class

    from lerobot_roborecover.policies.detectors.monitor import register_monitors
    from lerobot_roborecover.utils.plugins import register_plugins

    register_monitors()
    register_plugins()
    file = find_file(path, CONFIG_FILE, revision)
    try:
        kind = json.loads(file.read_text()).get("type")
    except (ValueError, AttributeError) as err:
        raise MonitorError(f"{file} is not a checkpoint's configuration ({err})") from None
    if kind not in RewardModelConfig.get_known_choices():
        known = sorted(k for k in RewardModelConfig.get_known_choices() if k.startswith("roborecover"))
        raise MonitorError(f"{path} is a checkpoint of type {kind!r}; a monitor is one of {known}")
    given = [f"--{name}={value}" for name, value in overrides.items()]
    if device is not None:
        given.append(f"--device={device}")
    try:
        config = RewardModelConfig.from_pretrained(path, revision=revision, cli_overrides=given)
    except (DecodingError, ParsingError) as err:
        reason: BaseException = err
        while reason.__cause__ is not None:
            reason = reason.__cause__
        raise MonitorError(f"{file}, with {overrides or 'no overrides'}: {reason}") from None
    config.pretrained_path = str(path)
    cls = get_reward_model_class(config.type)
    other = MonitorError(
        f"{path} is a reward model of type {config.type!r}, which does not judge single frames as a "
        "monitor does; train one with policies/train/monitor_qwen3vl.yaml or monitor_small.yaml"
    )
    if not hasattr(cls, "judge"):  # before it is loaded
        raise other
    model = cls.from_pretrained(path, config=config, revision=revision)
    model.eval()
    if not isinstance(model, Monitor):
        raise other
    return model
