"""Registers the Gymnasium ids when Gymnasium is imported, so that importing the package need not import it.

Gymnasium looks for no plugins. Where it is imported before this package, the ids are registered at once; else
a finder in `sys.meta_path` registers them at the end of its import.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType

_GYMNASIUM = "gymnasium"


def register() -> None:
    """Registers `roborecover/<Platform>-v0` of every platform; no platform is imported."""
    import gymnasium as gym

    # Not from `platforms` itself: Gymnasium's import, which leads here, may have begun in the middle of it.
    from lerobot_roborecover.platforms.registry import platform_names

    for name in platform_names():
        gym.register(
            id=f"roborecover/{name.capitalize()}-v0",
            entry_point="lerobot_roborecover.workers.recovery_env:make_env",
            kwargs={"platform": name},
        )


def register_with_gymnasium() -> None:
    """Registers the ids now where Gymnasium is imported, else when it is."""
    if _GYMNASIUM in sys.modules:
        register()
    elif not any(isinstance(finder, _GymnasiumFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _GymnasiumFinder())


class _GymnasiumFinder:
    """Finds Gymnasium as the other finders do, and registers the ids once its module has run."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Returns the spec of Gymnasium, whose loader registers the ids; of other modules none."""
        if fullname != _GYMNASIUM:
            return None
        for finder in list(sys.meta_path):
            spec = None if finder is self else finder.find_spec(fullname, path, target)
            if spec is not None:
                self._register_after(spec)
                return spec
        return None

    def _register_after(self, spec: ModuleSpec) -> None:
        loader = spec.loader
        if loader is None:  # a folder without code
            return
        execute = loader.exec_module

        def exec_module(module: ModuleType) -> None:
            execute(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            register()

        # On the instance: the loader keeps its type, which `inspect` and `importlib.resources` ask for.
        setattr(loader, "exec_module", exec_module)  # noqa: B010
