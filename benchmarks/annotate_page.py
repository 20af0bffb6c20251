"""How long a key takes on the annotation page, with a thousand episodes in the queue.

    python benchmarks/annotate_page.py [--episodes 1000] [--steps 300] [--side 256]

Makes a dataset of two cameras (drifting texture, which compresses badly), starts `curate annotate`,
opens it in headless Chromium and presses keys. A key's time runs from its event to the end of the animation
frame in which both cameras show the new frame.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

_MEASURE = """async ([key, shift, presses]) => {
  const times = [];
  for (let i = 0; i < presses; i++) {
    const painted = new Promise((done) =>
      document.addEventListener(
        "frameshown", () => requestAnimationFrame(() => setTimeout(done)), { once: true }));
    const began = performance.now();
    document.dispatchEvent(new KeyboardEvent("keydown", { key, shiftKey: shift, bubbles: true }));
    await painted;
    times.push(performance.now() - began);
  }
  return times;
}"""


def texture(side: int):
    """A picture by number, clip and camera: a fixed random texture that drifts, with a marker on it."""
    base = np.random.default_rng(0).integers(0, 256, (side // 4, side // 4, 3), np.uint8)
    base = np.kron(base, np.ones((4, 4, 1), np.uint8))

    def picture(number: int, clip: int, camera: int) -> np.ndarray:
        frame = np.roll(base, (number + 40 * clip, 2 * number * (camera + 1)), (0, 1)).copy()
        frame[8:24, 8 : 8 + number % (side - 16)] = 255
        return frame

    return picture


def main() -> None:
    """Measures and prints."""
    from tests.support.browser import browsing
    from tests.support.candidate_files import candidate_dataset

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--side", type=int, default=256)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = candidate_dataset(
            Path(folder) / "rollouts", args.episodes, steps=args.steps, picture=texture(args.side)
        )
        command = [
            sys.executable,
            "-m",
            "lerobot_roborecover.cli.main",
            "curate",
            "annotate",
            str(root),
            "--no-examples",
        ]
        server = subprocess.Popen(
            [*command, "--port", "0", "--annotator", "bench"], stdout=subprocess.PIPE, text=True,
            env={**os.environ, "XDG_STATE_HOME": folder},
        )  # fmt: skip
        try:
            address = server.stdout.readline().split()[-1]
            with browsing() as visit:
                measure(visit, address, args)
        finally:
            server.terminate()
            server.wait()
    print(json.dumps({"cpus": os.cpu_count(), "load_1min": round(os.getloadavg()[0], 1)}))


def measure(visit, address: str, args: argparse.Namespace) -> None:
    """Presses keys, and prints a line a kind of movement."""
    began = time.perf_counter()
    page, _ = visit(address)
    page.wait_for_selector("#cameras canvas[data-step='0']")
    page.keyboard.press("g")  # closes the guide that a first visit opens
    print(f"{args.episodes} episodes of {args.steps} frames, two cameras of {args.side} x {args.side}")
    print(f"page opened, first frame shown: {time.perf_counter() - began:.2f} s")
    _line("single frames while the episode still loads", page.evaluate(_MEASURE, ["ArrowRight", False, 60]))
    page.wait_for_selector("#loading:empty", state="attached")
    print(f"whole episode in the page: {time.perf_counter() - began:.2f} s after opening")
    for label, key, shift, presses in (
        ("single frames forward", "ArrowRight", False, args.steps - 100),
        ("single frames back", "ArrowLeft", False, args.steps - 100),
        ("ten frames forward", "ArrowRight", True, args.steps // 10 - 8),
        ("ten frames back", "ArrowLeft", True, args.steps // 10 - 8),
        ("to the end", "End", False, 1),
    ):
        _line(label, page.evaluate(_MEASURE, [key, shift, presses]))
    page.wait_for_load_state("networkidle")
    began = time.perf_counter()
    page.keyboard.press("d")
    page.keyboard.press("2")
    page.wait_for_selector("#done:text-is('1')")
    page.wait_for_selector("#cameras canvas[data-step='0']")
    print(f"vote cast, next episode shown: {time.perf_counter() - began:.2f} s")


def _line(label: str, times_ms: list[float]) -> None:
    median, high = np.percentile(times_ms, [50, 95])
    print(
        f"{label}: median {median:.1f} ms, 95 % within {high:.1f} ms, longest {max(times_ms):.1f} ms"
        f" ({len(times_ms)} keys)"
    )


if __name__ == "__main__":
    main()
