"""A checkpoint as the fast runner's policy host, for whoever runs one outside `roborecover eval`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any


def policy_config(policy: str, options: Sequence[str] = (), device: str | None = None) -> Any:
    """A checkpoint's own config.

    Args:
        policy: folder or Hub id of the checkpoint.
        options: `--name=value` or `name=value` options of it.
        device: of the policy; None takes what the config says.

    Raises:
        OptionError: there is no such checkpoint.
    """
    import lerobot.policies  # noqa: F401 - registers LeRobot's policy types
    from lerobot.configs.policies import PreTrainedConfig

    from lerobot_roborecover.interventions import configuration_intervention  # noqa: F401 - and ours
    from lerobot_roborecover.interventions.monitor.files import CONFIG_FILE, find_file
    from lerobot_roborecover.remote import configuration_remote  # noqa: F401

    find_file(policy, CONFIG_FILE)
    overrides = [f"--{o.removeprefix('--')}" for o in options]
    overrides += [f"--device={device}"] if device else []
    config = PreTrainedConfig.from_pretrained(policy, cli_overrides=overrides)
    config.pretrained_path = Path(policy)
    return config


def policy_host(
    config: Any, env: Any, *, rename_map: Mapping[str, str] | None = None, seed: int, max_batch: int
) -> Any:
    """The checkpoint with its processors, ready to act.

    Args:
        config: of `policy_config`.
        env: a recovery env config, which says what is observed.
        rename_map: the env's observation keys to the policy's, as `--rename_map` of `lerobot-eval`.
        seed: of the run.
        max_batch: observations per inference, at most.

    Raises:
        OptionError: the policy does not fit the environment.
    """
    from lerobot_roborecover.evaluate.runner import load_host

    runner = SimpleNamespace(max_batch=max_batch)
    return load_host(
        SimpleNamespace(policy=config, env=env, rename_map=dict(rename_map or {}), seed=seed, runner=runner)
    )
