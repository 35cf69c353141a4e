"""The figures of the README and of the pages, each drawn by a function without arguments."""

from collections.abc import Callable

from matplotlib.figure import Figure

from . import method, results

FIGURES: dict[str, Callable[[], Figure | bytes]] = {
    "overview": results.overview,
    "regions": method.regions,
    "diagnosis": results.diagnosis,
    "quality": results.quality,
    "ranks": results.ranks,
    "profiles": results.profiles,
}
"""By name, which is that of the file in `docs/figures`: figures, or the bytes of a PNG."""
