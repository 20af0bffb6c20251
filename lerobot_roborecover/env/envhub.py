"""What `env.py` files import that earlier versions of `roborecover envhub` wrote."""

from lerobot_roborecover.evaluation.envhub import HubScenarios, make_hub_env

__all__ = ["HubScenarios", "make_hub_env"]
