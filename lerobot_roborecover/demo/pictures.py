"""Recovery frames for the page, rendered by worker processes: an OpenGL driver may take its process down."""

from __future__ import annotations

import io
import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeout
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.simulators import Simulator, SimulatorError, make_simulator
from lerobot_roborecover.whole import write_whole

SIZE = 240
"""Width and height of a frame, pixels."""
_FRAME = {"observation_height": SIZE, "observation_width": SIZE}
_OPTIONS: dict[str, dict[str, Any]] = {"metaworld": _FRAME, "libero": _FRAME}
"""Simulator options by platform."""
_WORKERS = 2
_TIMEOUT_S = 120.0
_simulator: Simulator | None = None
"""Of a worker process: made with its first frame, kept for the next."""


def render_frames(scenarios: Sequence[Scenario], folder: Path) -> tuple[dict[str, Path], str]:
    """Renders every scenario's recovery point as a JPEG file.

    Args:
        scenarios: of one platform.
        folder: where the files go; those that are there already are kept.

    Returns:
        Files by scenario id, and why some or all are missing (empty when none is).
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = {s.id: folder / f"{s.id}-{s.sha256()[:8]}.jpg" for s in scenarios}
    todo = [s for s in scenarios if not files[s.id].is_file()]
    problem = _render(todo, files) if todo else ""
    return {i: path for i, path in files.items() if path.is_file()}, problem


def _render(scenarios: Sequence[Scenario], files: dict[str, Path]) -> str:
    # Spawned, not forked: OpenGL and forks do not mix.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(_WORKERS, len(scenarios)), context, initializer=_use_egl)
    problem = ""
    try:
        futures = {s.id: pool.submit(_frame, s) for s in scenarios}
        for scenario_id, future in futures.items():
            try:
                data = future.result(_TIMEOUT_S)
            except SimulatorError as err:
                problem = problem or f"{scenario_id}: {err}"
                continue
            write_whole(files[scenario_id], data)
    except BrokenProcessPool:
        problem = "a rendering process died, which an OpenGL driver can cause; see 'roborecover doctor'"
    except FutureTimeout:
        problem = f"a frame took more than {_TIMEOUT_S:g} s; see 'roborecover doctor'"
        for process in pool._processes.values():  # the executor offers no way to end one that hangs
            process.kill()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    return problem


def _use_egl() -> None:
    os.environ.setdefault("MUJOCO_GL", "egl")


def _frame(scenario: Scenario) -> bytes:
    """JPEG of a scenario's recovery point; runs in a worker process.

    Raises:
        SimulatorError: the simulator cannot be made, stepped or rendered.
    """
    global _simulator
    from PIL import Image

    from lerobot_roborecover.replay import hand_off

    try:
        if _simulator is None:
            _simulator = make_simulator(scenario.platform, **_OPTIONS.get(scenario.platform, {}))
        hand_off(_simulator, scenario, check=False)
        image = _simulator.render()
    except SimulatorError:
        raise
    except Exception as err:  # OpenGL backends raise types of their own, which may not even pickle
        raise SimulatorError(f"{type(err).__name__}: {err}") from None
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=88)
    return buffer.getvalue()
