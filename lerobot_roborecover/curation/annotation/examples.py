"""Example frames of the guide: the dataset's own, or rendered from the shipped scenarios when first needed.

Rendering runs in a process of its own, which an OpenGL driver may take down without the votes noticing, and
which ends with the server.

    python -m lerobot_roborecover.curation.annotation.examples PLATFORM FOLDER
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

from lerobot_roborecover.curation.annotation.guide import SLUGS, slug
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.platforms.findings import Status
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.workers.parent import ends_with_this

EXAMPLES_FOLDER = "examples"
MAX_EXAMPLE_BYTES = 2**23
_SIZE = 320
_OPTIONS = {"observation_height": _SIZE, "observation_width": _SIZE}


def cache_folder() -> Path:
    """Where rendered frames are kept for the next start."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "roborecover" / "guide-examples"


class Examples:
    """The guide's pictures.

    Args:
        root: the dataset; pictures in `meta/roborecover/examples/<cell>.png` (or `.jpg`) are its own.
        platform: whose shipped scenarios come first.
        render: render what the dataset lacks.
    """

    def __init__(self, root: Path, platform: str, *, render: bool):
        self._own = root / FOLDER / EXAMPLES_FOLDER
        self._rendered = cache_folder() / platform
        self._process: subprocess.Popen | None = None
        if render and any(self.picture(s) is None for s in SLUGS):
            module = [sys.executable, "-m", "lerobot_roborecover.curation.annotation.examples"]
            self._process = subprocess.Popen(
                [*module, platform, str(self._rendered)],
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                preexec_fn=ends_with_this(),
            )  # fmt: skip

    @property
    def coming(self) -> bool:
        """Whether more pictures may still come."""
        return self._process is not None and self._process.poll() is None

    def picture(self, name: str) -> tuple[bytes, str] | None:
        """A cell's picture and its media type; None where there is none (yet).

        Args:
            name: one of `guide.SLUGS`; anything else has no picture.
        """
        if name not in SLUGS:
            return None
        for path, kind in (
            (self._own / f"{name}.png", "image/png"),
            (self._own / f"{name}.jpg", "image/jpeg"),
            (self._rendered / f"{name}.jpg", "image/jpeg"),
        ):
            if path.is_file() and not path.is_symlink() and path.stat().st_size <= MAX_EXAMPLE_BYTES:
                return path.read_bytes(), kind
        return None

    def close(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()


def choose(platform: str) -> dict[str, Scenario]:
    """One shipped scenario by cell, of the platform if it has one."""
    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.platforms import all_platforms

    chosen: dict[str, Scenario] = {}
    for own in sorted(all_platforms(), key=lambda p: p.name != platform):
        if not own.default_scenarios or any(c.status is not Status.OK for c in own.examine(False, {})):
            continue  # nothing to show, or it cannot run here
        for scenario in sorted(load_scenarios(own.default_scenarios), key=lambda s: s.id):
            chosen.setdefault(slug(scenario.stage, scenario.deviation), scenario)
    return {s: chosen[s] for s in SLUGS if s in chosen}


def render(platform: str, folder: Path) -> None:
    """Renders the recovery frames of the chosen scenarios, as far as this machine can."""
    from PIL import Image

    from lerobot_roborecover.platforms import make_simulator
    from lerobot_roborecover.replay.handoff import hand_off

    os.environ.setdefault("MUJOCO_GL", "egl")
    folder.mkdir(parents=True, exist_ok=True)
    simulators: dict = {}
    for name, scenario in sorted(choose(platform).items(), key=lambda item: item[1].platform):
        path = folder / f"{name}.jpg"
        if path.exists():
            continue
        if scenario.platform not in simulators:
            simulators[scenario.platform] = make_simulator(scenario.platform, **_OPTIONS)
        simulator = simulators[scenario.platform]
        hand_off(simulator, scenario, check=False)
        buffer = io.BytesIO()
        Image.fromarray(simulator.render()).save(buffer, "JPEG", quality=88)
        atomic_write(path, buffer.getvalue())


if __name__ == "__main__":
    render(sys.argv[1], Path(sys.argv[2]))
