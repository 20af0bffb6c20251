"""Runs teleoperation: the simulator's thread, the page's server, and at the end the candidate dataset."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.annotation.votes import check_name
from lerobot_roborecover.platforms import make_simulator, platform_named
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.options import internal, option
from lerobot_roborecover.utils.text import install_command
from lerobot_roborecover.web.serve import HOST, kept_tokens, listen, make_server, own_hosts
from lerobot_roborecover.web.teleop.hub import Hub
from lerobot_roborecover.web.teleop.simulator_thread import SimulatorThread
from lerobot_roborecover.web.teleop.spacemouse import SpaceMouse
from lerobot_roborecover.web.teleop.starts import StartPoint
from lerobot_roborecover.web.teleop.store import Store, read_recording
from lerobot_roborecover.web.teleop.write import check_open, recordings_folder, write_dataset

DEFAULT_PORT = 8732


@dataclass(frozen=True)
class TeleopConfig:
    """One operator's session."""

    dataset: Path = option(positional=True)
    """The candidate dataset: a new folder, or one that this command made."""
    platform: str = "metaworld"
    """Which can be driven by hand, e.g. libero."""
    operator: str = option("", metavar="NAME", show_default=False)
    """Your name or a pseudonym; the controller in the dataset."""
    starts: Sequence[StartPoint] = internal(())
    port: int = DEFAULT_PORT
    """On this machine alone; 0 takes a free one."""
    rate_hz: float | None = option(None, name="rate", metavar="HZ")
    """Control steps a second, at most (the simulator's own rate)."""
    fps: float = 15.0
    """Live pictures a second, at most."""
    view_size: int = option(320, name="view", metavar="PIXELS")
    """Size of the live pictures."""
    size: int | None = option(None, metavar="PIXELS")
    """Size of the dataset's pictures; 0: none (the platform's own)."""
    frame_stride: int = internal(1)
    """Steps from one of the dataset's pictures to the next, where rendering is slow."""
    spacemouse: float | None = option(None, nargs="?", const=0.5, metavar="SPEED")
    """Drive with one that is plugged into this machine, too; SPEED is up to 1 (0.5)."""
    options: Mapping[str, Any] = internal(factory=dict)
    """Options of the simulator, beside its pictures."""


def serve(config: TeleopConfig, say: Callable[[str], None]) -> None:
    """Serves until interrupted, then writes what was saved into the dataset.

    Args:
        config: the session.
        say: told the address and what happens, one line each.

    Raises:
        ScenarioError: something cannot be read or written, or the port is taken.
        SimulatorError: the simulator cannot be had.
    """
    try:
        import uvicorn  # noqa: F401 - what is missing is said before a simulator starts
        import websockets  # noqa: F401 - uvicorn speaks websockets with it

        from lerobot_roborecover.web.teleop.server import NAME, TeleopApp, make_app
    except ImportError as err:
        raise ScenarioError(f"teleoperation needs {err.name}: {install_command('teleop')}") from None
    platform_named(config.platform).controls()
    check_open(config.dataset)
    operator = check_operator(config.operator)
    store = Store(recordings_folder(config.dataset))
    try:
        _check_platform(store, config.platform)
        listener = listen(config.port)
        try:
            port = listener.getsockname()[1]
            hub = Hub()
            options = {**config.options, **view_options(config.platform, config.view_size)}
            options |= platform_named(config.platform).controls().live_options
            simulation = SimulatorThread(
                lambda: make_simulator(config.platform, **options),
                operator, config.starts, store, hub, config.rate_hz, config.fps,
            )  # fmt: skip
            simulation.start()
            simulation.ready.wait()
            if simulation.error is not None:
                raise simulation.error
            mouse = None
            if config.spacemouse is not None:
                mouse = SpaceMouse(simulation.pilot, config.spacemouse)
                mouse.start()
            token = kept_tokens("teleop", config.dataset, [operator])[operator]
            try:  # from the first line on: who reads the address may interrupt at once
                say(f"{operator}: {len(config.starts)} starts  http://{HOST}:{port}/{NAME}/?token={token}")
                say(f"recordings are kept in {store.folder}; Ctrl-C stops and writes {config.dataset}")
                make_server(make_app(TeleopApp(token, own_hosts(port), hub, simulation.pilot))).run(
                    sockets=[listener]
                )
            except KeyboardInterrupt:
                say("stopped; writing the dataset. Ctrl-C leaves it to `roborecover curate teleop --write`")
            finally:
                if mouse is not None:
                    mouse.stop()
                simulation.stop()
                simulation.join()
        finally:
            listener.close()
        _write(config, store, say)
    finally:
        store.close()


def write(config: TeleopConfig, say: Callable[[str], None]) -> None:
    """Writes what earlier sessions saved into the dataset, and serves nothing.

    Raises:
        ScenarioError: there is nothing, or it cannot be written.
    """
    store = Store(recordings_folder(config.dataset))
    try:
        _check_platform(store, config.platform)
        _write(config, store, say)
    finally:
        store.close()


def _write(config: TeleopConfig, store: Store, say: Callable[[str], None]) -> None:
    write_dataset(
        config.dataset, store, config.platform, dict(config.options), config.size, say, config.frame_stride
    )


def view_options(platform: str, size: int | None) -> dict[str, Any]:
    """A simulator's options for square pictures of a size; its own where that is None."""
    return (
        {"obs_type": "pixels_agent_pos"} if size is None else platform_named(platform).picture_options(size)
    )


def check_operator(name: str) -> str:
    """An operator's name, as it goes into ids.

    Raises:
        ScenarioError: it is not plain.
    """
    try:
        return check_name(name)
    except ScenarioError as err:
        raise ScenarioError(str(err).replace("annotator", "operator", 1)) from None


def _check_platform(store: Store, platform: str) -> None:
    paths = store.paths()
    if paths and (found := read_recording(paths[0]).task.platform) != platform:
        raise ScenarioError(
            f"{store.folder} holds recordings of {found}, not {platform}; name another dataset"
        )
