from ._GLOBAL_CONFIGS import CONFIGS_PATH

__all__ = ["CONFIGS_PATH"]
