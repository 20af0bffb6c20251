"""A headless Chromium for tests of pages: no network, no profile, every console message and error kept."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import pytest

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


def chromium() -> str:
    """Path of the system's Chromium; skips the test where there is none."""
    found = find_chromium()
    if not found:
        pytest.skip("no Chromium on this machine: apt-get install chromium, or set ROBORECOVER_CHROMIUM=PATH")
    return found


def playwright_api() -> ModuleType:
    """Playwright; skips the test where it is not installed."""
    return pytest.importorskip(
        "playwright.sync_api", reason="no Playwright: pip install 'lerobot_env_roborecover[test]'"
    )


@contextmanager
def browsing() -> Iterator:
    """A browser for pages of a server on this machine.

    Yields:
        A function that opens an address as a visitor of its own, with cookies and storage of their own: it
        returns the page, and a list that collects console errors, page errors and requests that leave the
        address's host.
    """
    playwright = playwright_api()
    program = chromium()
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, headless=True, args=list(FLAGS))

        def visit(url: str) -> tuple:
            complaints: list[str] = []
            page = browser.new_context(viewport={"width": 1366, "height": 768}).new_page()
            page.set_default_timeout(SLOW_MS)
            host = url.split("/")[2]
            page.on(
                "console", lambda m: complaints.append(m.text) if m.type in ("error", "warning") else None
            )
            page.on("pageerror", lambda error: complaints.append(str(error)))
            page.on(
                "request",
                lambda made: (
                    None if made.url.startswith((f"http://{host}/", "data:", "blob:"))
                    else complaints.append(f"request to {made.url}")
                ),
            )  # fmt: skip
            page.goto(url)
            return page, complaints

        try:
            yield visit
        finally:
            browser.close()


@contextmanager
def open_page(path: Path, profile: Path) -> Iterator[tuple]:
    """Opens a file.

    Args:
        path: an HTML file on disk.
        profile: folder for the browser's own files.

    Yields:
        The page, and a list that collects console errors, page errors and requests that leave the file.
    """
    playwright = playwright_api()
    program = chromium()
    complaints: list[str] = []

    def request(made) -> None:
        if not made.url.startswith(("file:", "data:", "blob:")):
            complaints.append(f"request to {made.url}")

    with playwright.sync_playwright() as driver:
        context = driver.chromium.launch_persistent_context(
            str(profile), executable_path=program, headless=True, args=list(FLAGS), offline=True,
            viewport={"width": 1200, "height": 900},
        )  # fmt: skip
        try:
            page = context.new_page()
            page.on(
                "console", lambda m: complaints.append(m.text) if m.type in ("error", "warning") else None
            )
            page.on("pageerror", lambda error: complaints.append(str(error)))
            page.on("request", request)
            page.goto(path.resolve().as_uri())
            yield page, complaints
        finally:
            context.close()
