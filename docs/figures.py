"""Draws the figures of the README and of the pages into docs/figures.

    python docs/figures.py [NAME ...]
    python docs/figures.py --explorer runs/demo/explorer.html

The second form draws docs/guides/explorer.png, for which it needs Chromium and a run's page.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

from PIL import Image

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE)]

from _figures import FIGURES, explorer  # noqa: E402

from sme_registry.io import write_atomically  # noqa: E402
from sme_registry.plots.style import encoded  # noqa: E402

FOLDER = HERE / "figures"
_COLOURS = 64


def picture(name: str) -> bytes:
    """The PNG of a figure, with few colours."""
    figure, content = FIGURES[name](), io.BytesIO()
    file = figure if isinstance(figure, bytes) else encoded(figure, ["png"])["png"]
    drawn = Image.open(io.BytesIO(file)).convert("RGB")
    drawn.quantize(_COLOURS, dither=Image.Dither.NONE).save(content, format="PNG", optimize=True)
    return content.getvalue()


def main() -> None:
    """Draw what is asked for; without arguments, every figure but the explorer's."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(FIGURES)}")
    parser.add_argument("--explorer", type=Path, metavar="PAGE")
    options = parser.parse_args()
    if unknown := set(options.names) - FIGURES.keys():
        parser.error(f"{', '.join(sorted(unknown))}: must be of {', '.join(FIGURES)}.")
    if options.explorer:
        print(f"wrote {explorer.draw(options.explorer)}")
    for name in options.names or (() if options.explorer else FIGURES):
        print(f"wrote {write_atomically(FOLDER / f'{name}.png', picture(name))}", flush=True)


if __name__ == "__main__":
    main()
