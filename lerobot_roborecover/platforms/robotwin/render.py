"""How SAPIEN renders RoboTwin's scenes: one of four qualities, or not at all.

RoboTwin asks for its ray tracer in code, at every reset, and makes cameras, lights and materials
unconditionally. Both are answered here for the duration of a reset, without touching RoboTwin's files:

- a quality replaces the shader that RoboTwin names; physics is the same whatever the quality;
- without rendering, scenes hold a physics system alone, and what only matters to pictures is dropped, so that
  replaying and low-dimensional evaluation need no Vulkan device.
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from typing import Any

from lerobot_roborecover.platforms.simulator import SimulatorError

QUALITIES = ("rt", "default", "minimal", "trivial")
"""`rt`: RoboTwin's own ray tracing; `default`: rasterised with shadows; `minimal`: the same materials without
shadows; `trivial`: flat colours, for CPUs."""

_SHADOWED = ("rt", "default")
_RENDER_CLASSES = (
    "RenderBodyComponent",
    "RenderMaterial",
    "RenderTexture2D",
    "RenderShapeBox",
    "RenderShapeSphere",
    "RenderShapeCapsule",
    "RenderShapeCylinder",
    "RenderShapePlane",
    "RenderShapeTriangleMesh",
)
_NO_DEVICE = (
    "SAPIEN found no Vulkan device to render with. On an NVIDIA machine install the driver's Vulkan part "
    "(libvulkan1 and nvidia_icd.json); on a CPU install Mesa 25 or later and set VK_ICD_FILENAMES to its "
    "lvp_icd.json with --env.render_quality=trivial; or use --env.obs_type=state, which renders nothing"
)


@contextlib.contextmanager
def rendering(quality: str) -> Generator[None]:
    """Scenes made within are rendered with `quality`.

    Raises:
        SimulatorError: there is no Vulkan device, or it cannot do what the quality needs.
    """
    import sapien
    from sapien.wrapper.scene import Scene

    render = sapien.render

    def shader(_: str) -> None:
        choose(quality)

    def unshadowed(method: Any) -> Any:
        def add(self: Any, *args: Any, **kwargs: Any) -> Any:
            return method(self, *args, **{**kwargs, "shadow": False})

        return add

    choose = render.set_camera_shader_dir
    replaced: list[tuple[Any, str, Any]] = [(render, "set_camera_shader_dir", shader)]
    if quality != "rt":
        nothing = _ignore
        replaced += [
            (render, name, nothing)
            for name in (
                "set_ray_tracing_samples_per_pixel",
                "set_ray_tracing_path_depth",
                "set_ray_tracing_denoiser",
            )
        ]
    if quality not in _SHADOWED:
        replaced += [
            (Scene, name, unshadowed(getattr(Scene, name)))
            for name in ("add_directional_light", "add_point_light", "add_spot_light")
        ]
    try:
        with _replaced(replaced):
            yield
    except RuntimeError as err:
        text = str(err)
        if "rendering device" in text or "vulkan" in text.lower() or "vk::" in text:
            raise SimulatorError(f"{_NO_DEVICE} (SAPIEN: {text})") from err
        raise


@contextlib.contextmanager
def no_rendering() -> Generator[None]:
    """Scenes made within have physics alone and need no Vulkan device."""
    import sapien
    import sapien.core
    from sapien import pysapien
    from sapien.wrapper import engine, urdf_loader
    from sapien.wrapper.scene import Scene

    class PhysicsScene(Scene):
        """A scene that ignores what only matters to pictures."""

        def __init__(self, systems: Any = None):
            super().__init__([sapien.physx.PhysxCpuSystem()])

        add_camera = add_mounted_camera = _dummy
        add_point_light = add_directional_light = add_spot_light = add_area_light_for_ray_tracing = _dummy
        set_ambient_light = set_environment_map = update_render = _ignore
        ambient_light = (0.5, 0.5, 0.5)

        def add_ground(
            self, altitude: Any, render: bool = True, material: Any = None, *_: Any, **__: Any
        ) -> Any:
            return super().add_ground(altitude, render=False, material=material)

    def create_scene(self: Any, config: Any = None) -> Scene:
        if config is not None:
            pysapien.physx.set_scene_config(config)
        return PhysicsScene()

    add_component = sapien.Entity.add_component

    def add_physical(self: Any, component: Any) -> Any:
        return self if isinstance(component, _Dummy) else add_component(self, component)

    replaced: list[tuple[Any, str, Any]] = [
        (engine.Engine, "create_scene", create_scene),
        (sapien.Entity, "add_component", add_physical),
    ]
    for module in (sapien, sapien.core):
        replaced += [(module, "SapienRenderer", _Dummy), (module, "Scene", PhysicsScene)]
    for module in (sapien.render, pysapien.render):
        replaced += [(module, name, _Dummy) for name in _RENDER_CLASSES if hasattr(module, name)]
        replaced += [(module, name, _ignore) for name in dir(module) if name.startswith("set_")]
    replaced += [(urdf_loader, name, _Dummy) for name in _RENDER_CLASSES if hasattr(urdf_loader, name)]
    with _replaced(replaced):
        yield


class _Dummy:
    """Takes any call and any attribute, and does nothing."""

    def __init__(self, *_: Any, **__: Any):
        pass

    def __call__(self, *_: Any, **__: Any) -> _Dummy:
        return self

    def __getattr__(self, name: str) -> _Dummy:
        if name.startswith("__"):
            raise AttributeError(name)
        return self


def _dummy(*_: Any, **__: Any) -> Any:
    return _Dummy()


def _ignore(*_: Any, **__: Any) -> None:
    return None


@contextlib.contextmanager
def _replaced(attributes: list[tuple[Any, str, Any]]) -> Generator[None]:
    with contextlib.ExitStack() as stack:
        for owner, name, value in attributes:
            stack.callback(setattr, owner, name, getattr(owner, name))
            setattr(owner, name, value)
        yield
