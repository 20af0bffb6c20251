"""Recovery frames for the page, rendered by worker processes: an OpenGL driver may take its process down."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.workers.jobs import Done, JobError, JobPool, simulator_of_worker

SIZE = 240
"""Width and height of a frame, pixels."""
_WORKERS = 2
_TIMEOUT_S = 120.0


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
    problem = ""
    options = platform_named(scenarios[0].platform).picture_options(SIZE)
    with JobPool(scenarios[0].platform, options, _WORKERS, limit_s=_TIMEOUT_S) as pool:
        for scenario, outcome in pool.outcomes(_frame, scenarios, lambda s: (s,)):
            if isinstance(outcome, Done):
                atomic_write(files[scenario.id], outcome.value)
            elif isinstance(outcome, JobError):
                problem = problem or f"{scenario.id}: {outcome.words}"
            else:
                return (
                    "a rendering process died or hung, which an OpenGL driver can cause: "
                    f"{outcome.message}; see 'roborecover doctor'"
                )
    return problem


def _frame(scenario: Scenario) -> bytes:
    """JPEG of a scenario's recovery point; runs in a worker process.

    Raises:
        SimulatorError: the simulator cannot be made, stepped or rendered.
    """
    from PIL import Image

    from lerobot_roborecover.replay.handoff import hand_off

    simulator = simulator_of_worker()
    hand_off(simulator, scenario, check=False)
    image = simulator.render()
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=88)
    return buffer.getvalue()
