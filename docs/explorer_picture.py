"""Draws docs/guides/explorer.png: the top of an explorer, by Chromium.

python docs/explorer_picture.py runs/demo/explorer.html
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

PICTURE = Path(__file__).parent / "guides" / "explorer.png"
_COLOURS = 256


def main(page: Path) -> None:
    """Open the page, move to a state outside the cube's centre, and save the picture."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        tab = browser.new_page(viewport={"width": 1080, "height": 1010}, color_scheme="light")
        tab.goto(page.absolute().as_uri())
        tab.get_by_role("application", name="Map").focus()
        for key in ("Shift+ArrowLeft", "Shift+ArrowLeft", "Shift+ArrowDown"):
            tab.keyboard.press(key)
        tab.locator("html[data-ready=true]").wait_for()
        tab.evaluate("document.activeElement.blur()")
        tab.screenshot(path=PICTURE)
        browser.close()
    picture = Image.open(PICTURE).convert("RGB")
    picture.quantize(_COLOURS).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
