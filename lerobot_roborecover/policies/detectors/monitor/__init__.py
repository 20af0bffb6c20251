"""Recovery monitors as LeRobot reward models: `roborecover_monitor` (Qwen3-VL with LoRA) and
`roborecover_monitor_small` (a compact network for every-step use without a large GPU).

Light: importing this package imports neither LeRobot nor torch.
"""


def register_monitors() -> None:
    """Registers both types with LeRobot."""
    from lerobot_roborecover.policies.detectors.monitor import (  # noqa: F401 - registers each on import
        configuration_roborecover_monitor,
        configuration_roborecover_monitor_small,
    )
