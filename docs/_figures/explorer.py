"""docs/guides/explorer.png: the top of an explorer, by Chromium."""

from __future__ import annotations

import shutil
from pathlib import Path

from PIL import Image

PICTURE = Path(__file__).parents[1] / "guides" / "explorer.png"
_COLOURS = 256


def draw(page: Path) -> Path:
    """Open a run's page, move to a state off the cube's centre, and save the picture."""
    from playwright.sync_api import sync_playwright

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
    return PICTURE
