"""Detectors score, step by step, whether the acting policy will fail. Monitors are detectors; so are
LeRobot's own reward models, and what needs no training.

Light: importing this package imports neither LeRobot nor torch.
"""


def register_detectors() -> None:
    """Registers the reward-model types of the detectors with LeRobot."""
    from lerobot_roborecover.policies.detectors import (  # noqa: F401 - registers each on import
        configuration_policy,
        configuration_rules,
        configuration_states,
    )
