"""359 recovery scenarios on metaworld, for LeRobot's EnvHub.

Made by `roborecover dataset envhub`; needs what requirements.txt names.
"""

from lerobot_roborecover.evaluation.envhub import HubScenarios, make_hub_env, make_hub_processors

OFFER = HubScenarios(
    platform="metaworld",
    scenarios="metaworld_recovery",
    revision=None,
    split="test",
)


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg=None):
    """`{group: {scenario id: vector env}}`; `cfg` is a `HubEnvConfig`, whose further fields are options."""
    return make_hub_env(OFFER, n_envs=n_envs, use_async_envs=use_async_envs, cfg=cfg)


def make_env_processors(cfg=None):
    """LeRobot's preprocessor and postprocessor of this platform, which a `HubEnvConfig` lacks."""
    return make_hub_processors(OFFER, cfg)
