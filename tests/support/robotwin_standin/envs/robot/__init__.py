from .robot import Robot

__all__ = ["Robot"]
