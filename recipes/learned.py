"""A learned policy that acts in a simulator directly: as a starter set's weak controller, or until an expert
takes over."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_roborecover.platforms import Simulator, platform_named
from lerobot_roborecover.scenario import Task


class LearnedPolicy:
    """A LeRobot checkpoint that reads the low-dimensional state, run as `lerobot-eval` would: a controller.

    Args:
        simulator: made with `obs_type="state"`.
        task: whose instruction the policy gets.
        checkpoint: folder or Hub id.
    """

    def __init__(self, simulator: Simulator, task: Task, checkpoint: str):
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        config = PreTrainedConfig.from_pretrained(checkpoint)
        config.device = "cpu"
        self._policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
        overrides = {"device_processor": {"device": "cpu"}}
        self._before, self._after = make_pre_post_processors(
            config, checkpoint, preprocessor_overrides=overrides
        )
        self._simulator, self._task = simulator, task
        self._platform = platform_named(task.platform)
        self.reset()

    def reset(self) -> None:
        """Forgets the episode."""
        self._policy.reset()

    def __call__(self, _t: int) -> np.ndarray:
        """See `Controller`."""
        import torch
        from lerobot.envs.utils import preprocess_observation

        seen = self._platform.process_observation(preprocess_observation(_batched(self._simulator.observe())))
        with torch.inference_mode():
            observation = self._before({**seen, "task": [self._task.instruction]})
            return self._after(self._policy.select_action(observation))[0].numpy().astype(np.float64)


def _batched(observation: Mapping[str, Any]) -> dict[str, Any]:
    return {k: _batched(v) if isinstance(v, Mapping) else v[None] for k, v in observation.items()}
