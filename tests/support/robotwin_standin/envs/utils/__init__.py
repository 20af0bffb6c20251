from .create_actor import Actor, UnStableError, create_box

__all__ = ["Actor", "UnStableError", "create_box"]
