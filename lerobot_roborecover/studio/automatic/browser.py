"""A headless Chromium without network, profile or screen."""

from __future__ import annotations

import os
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

from lerobot_roborecover.scenario import ScenarioError

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
SLOW_MS = 120_000
"""A busy machine is no failure."""


def find_chromium() -> str | None:
    """Path of the system's Chromium, or of `ROBORECOVER_CHROMIUM`; None where there is none."""
    return os.environ.get("ROBORECOVER_CHROMIUM") or next(filter(None, map(shutil.which, _NAMES)), None)


@contextmanager
def browser() -> Generator[Any]:
    """A running Playwright browser.

    Raises:
        ScenarioError: Playwright or Chromium is not installed.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise ScenarioError(
            "automatic annotators need playwright: pip install 'lerobot_env_roborecover[automatic]'"
        ) from None
    program = find_chromium()
    if program is None:
        raise ScenarioError(
            "automatic annotators need Chromium, and there is none: apt-get install chromium, or name one "
            "with ROBORECOVER_CHROMIUM"
        )
    with sync_playwright() as driver:
        made = driver.chromium.launch(executable_path=program, headless=True, args=list(FLAGS))
        try:
            yield made
        finally:
            made.close()
