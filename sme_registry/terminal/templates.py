"""Jinja2 environments whose templates put verdicts in words: an undefined name is an error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

__all__ = ["environment"]


def environment(folder: Path, *, autoescape: bool) -> Environment:
    """The templates of a folder, with the filters of this module.

    Args:
      folder: of the templates.
      autoescape: whether values are escaped for HTML.
    """
    templates = Environment(
        loader=FileSystemLoader(folder),
        autoescape=autoescape,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = (fixed, signed, percent, thousands, conjunction, plural)
    templates.filters |= {function.__name__: function for function in filters}
    return templates


def fixed(value: float, digits: int = 2) -> str:
    """`0.44`, `−0.02`, and no negative zero."""
    return f"{value:z.{digits}f}".replace("-", "−")


def signed(value: float, digits: int = 2) -> str:
    """`+0.44`, `−0.02`, `0.00`."""
    text = fixed(value, digits)
    return text if text.startswith("−") or float(text) == 0.0 else f"+{text}"


def percent(value: float, digits: int = 0) -> str:
    """`44%`."""
    return f"{value:.{digits}%}"


def thousands(value: float) -> str:
    """`20,000`; a number with decimals keeps those that it needs."""
    return f"{value:,}" if isinstance(value, int) else f"{value:,g}"


def conjunction(names: Sequence[str]) -> str:
    """`PPO, TD3 and SAC`."""
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def plural(count: int, one: str, many: str = "") -> str:
    """`1 pair`, `3 pairs`, `2 classes`."""
    return f"{count:,} {one if count == 1 else many or f'{one}s'}"
