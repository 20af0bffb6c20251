"""`env.py` of an environment on the Hub, as a test publishes it: a point that is to leave its place."""

import gymnasium as gym
import numpy as np


class Point(gym.Env):
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gym.spaces.Dict({"agent_pos": gym.spaces.Box(-10.0, 10.0, (2,), np.float64)})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.np_random.uniform(-1, 1, 2)
        return {"agent_pos": self.at.copy()}, {}

    def step(self, action):
        self.at = self.at + 0.1 * np.asarray(action)
        return {"agent_pos": self.at.copy()}, 0.0, False, False, {"is_success": bool(self.at[0] > 1.5)}


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg=None):
    return gym.vector.SyncVectorEnv([Point] * n_envs)
