"""Takes the picture of the demo's page that README shows.

    python -m scripts.demo_picture outputs/demo/report.html docs/images/demo.png

Needs Chromium (or $ROBORECOVER_CHROMIUM) and playwright: the top of the page and the first scenarios of its
gallery, side by side.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from tests.support.browser import FLAGS, find_chromium

_SIZE = {"width": 900, "height": 1100}


def main(page_file: Path, out: Path) -> None:
    """Takes the picture."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=find_chromium(), headless=True, args=list(FLAGS))
        page = browser.new_context(viewport=_SIZE, color_scheme="light").new_page()
        page.goto(page_file.resolve().as_uri())
        parts = [page.screenshot()]
        page.evaluate("document.getElementById('count').scrollIntoView()")
        page.evaluate("document.querySelectorAll('#cards img').forEach(image => image.loading = 'eager')")
        page.evaluate("Promise.all(Array.from(document.querySelectorAll('#cards img'), i => i.decode()))")
        parts.append(page.screenshot())
        browser.close()
    pictures = [Image.open(io.BytesIO(data)) for data in parts]
    whole = Image.new("RGB", (sum(p.width for p in pictures), _SIZE["height"]), "white")
    for k, picture in enumerate(pictures):
        whole.paste(picture, (k * _SIZE["width"], 0))
    whole.quantize(128).save(out, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
