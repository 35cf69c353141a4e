"""The pictures of the gallery: π* over two state channels, a panel for each of two action channels.

A picture is a small PNG with few colours and no text: viridis from 0 (dark) to 1 (light) in
sixteen steps, the training cube as a double line, and diagonal lines where a limit forbids π*.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from PIL import Image

from sme_registry.explorer.page import resting
from sme_registry.io import write_atomically
from sme_registry.spec import EnvFile, SMESpec, StreamFile, catalogue
from sme_registry.task import Task, materialize
from sme_registry.task.draw import Array

from .entries import document, entries

EPSILON = 1.0  # the map covers [−½, 1½]²
_COLOURS, _CLEAR, _BLACK, _WHITE = 16, 16, 17, 18  # numbers in the palette
_POINTS = 81  # of a computed map, along a side
_SIDE, _SMALL, _GAP = 160, 78, 8  # pixels
_HATCH = 8  # pixels between lines of a limit
_STREAM_PANELS = 5


class Panel(NamedTuple):
    """One map: an action channel over two state channels, from 0."""

    action: int
    over: tuple[int, int]


def panels(task: Task) -> list[Panel]:
    """Two action channels over the first two state channels that their agent observes."""
    if len(task.owned) == 1:
        return [Panel(i, (0, 1)) for i in range(min(2, task.spec.action_dim))]
    agents = zip(task.owned[:2], task.observed[:2], strict=True)
    return [Panel(owned.start, (observed[0], observed[1])) for owned, observed in agents]


def picture(name: str) -> bytes:
    """The PNG of an entry; of a stream, π* at the start of its first five phases."""
    shown = document(entries()[name])
    if isinstance(shown, SMESpec):
        images = _panels(materialize(shown), _SIDE)
    else:
        phases = shown.phases[:_STREAM_PANELS]
        images = [_panels(materialize(phase.spec), _SMALL)[0] for phase in phases]
    gap = np.full((images[0].shape[0], _GAP), _CLEAR, np.uint8)
    row = [part for image in images for part in (gap, image)][1:]
    return _png(np.concatenate(row, axis=1))


def names() -> dict[str, str]:
    """The file of each entry's picture, by the entry's name; tasks with the same π* share one."""
    owners: dict[Any, str] = {}
    for file in catalogue.entries(EnvFile):
        owners.setdefault(_key(file), file.versioned_name)
    shared = {f.versioned_name: f"{owners[_key(f)]}.png" for f in catalogue.entries(EnvFile)}
    return shared | {name: f"{name}.png" for name in catalogue.names(StreamFile)}


def _key(file: EnvFile) -> Any:
    """What the picture depends on: a fingerprint has π* and the limits at fixed probes."""
    agents = file.spec.team and file.spec.team.agents
    return file.fingerprint.optimal_action, file.fingerprint.limit, agents


def draw(folder: Path) -> None:
    """Write the pictures that a folder lacks, and remove those of no entry."""
    files = names()
    for name, picture_name in files.items():
        path = folder / picture_name
        if not path.exists():
            print(f"drawing {name}", flush=True)
            write_atomically(path, picture(name))
    for path in folder.glob("*.png"):
        if path.name not in files.values():
            path.unlink()


def _optimum(task: Task, over: tuple[int, int]) -> tuple[Array, Array | None]:
    """π* and the limits (None without safety), `[n, n, A]`, over two channels, others at ½."""
    side = -EPSILON / 2 + (np.arange(_POINTS) + 0.5) * (1 + EPSILON) / _POINTS
    s = np.tile(resting(task.spec)[: task.spec.state_dim], (_POINTS**2, 1))
    s[:, over[0]], s[:, over[1]] = np.tile(side, _POINTS), np.repeat(side, _POINTS)

    def on_grid(function: Callable[[Array], Array]) -> Array:
        blocks = [function(block) for block in np.array_split(s, _POINTS)]  # fit in cache
        return np.concatenate(blocks).reshape(_POINTS, _POINTS, -1)

    return on_grid(task.policy), on_grid(task.limit) if task.limiting else None


def _panels(task: Task, points: int) -> list[npt.NDArray[np.uint8]]:
    shown = panels(task)
    maps = {over: _optimum(task, over) for over in {panel.over for panel in shown}}
    images = []
    for i, over in shown:
        a, limit = maps[over]
        images.append(_panel(a[:, :, i], None if limit is None else limit[:, :, i], points))
    return images


def _panel(a: Array, limit: Array | None, points: int) -> npt.NDArray[np.uint8]:
    """Numbers of the palette `[points, points]`, the first row at the top."""
    a = _resized(a, points)
    image = np.minimum(a * _COLOURS, _COLOURS - 1).astype(np.uint8)
    if limit is not None:
        i, j = np.indices(a.shape)
        image[(a > _resized(limit, points)) & ((i + j) % _HATCH == 0)] = _BLACK
    _outline(image)
    return image[::-1]


def _resized(values: Array, points: int) -> Array:
    """`[n, n]` values as `[points, points]`: π* is smooth, and a deep one is slow."""
    at = (np.arange(points) + 0.5) * len(values) / points - 0.5
    for axis in (0, 1):
        values = np.apply_along_axis(lambda v: np.interp(at, np.arange(len(v)), v), axis, values)
    return values


def _outline(image: npt.NDArray[np.uint8]) -> None:
    """The training cube: black within white, to be visible on every colour."""
    low = round(len(image) * (EPSILON / 2) / (1 + EPSILON))
    for inset, colour in enumerate((_WHITE, _BLACK)):
        first, last = low - 1 + inset, len(image) - low - inset
        for edge in (first, last):
            image[edge, first : last + 1] = image[first : last + 1, edge] = colour


def _png(image: npt.NDArray[np.uint8]) -> bytes:
    shades = colormaps["viridis"](np.linspace(0, 1, _COLOURS), bytes=True)[:, :3]
    palette: Sequence[int] = [*shades.ravel().tolist(), *(255,) * 3, *(0,) * 3, *(255,) * 3]
    drawn = Image.fromarray(image, mode="P")
    drawn.putpalette(palette)
    content = io.BytesIO()
    drawn.save(content, format="PNG", optimize=True, transparency=_CLEAR, bits=8)
    return content.getvalue()
