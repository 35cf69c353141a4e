"""The reference of Python names: a page for each entry of a list of modules, from their docstrings.

The list is in `docs/reference/python.md`. Before a build, a page of autodoc directives for each
entry is written to `docs/reference/python/`, which git ignores. An object is
documented once, under its shortest name, which is also the one that people import; other modules
link to it.
"""

from __future__ import annotations

import importlib
import inspect
import re
import typing
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any

from docstrings import short_types
from pydantic.fields import FieldInfo
from sphinx.application import Sphinx
from sphinx.util.typing import stringify_annotation

from sme_registry.io import write_atomically

PAGE = "reference/python"
aliases: dict[str, str] = {}  # other public paths of an object → the one that documents it
_LISTED = re.compile(r"`((?:sme_registry|leaderboard)[a-z0-9_.]*)`")


def modules(page: str) -> list[list[str]]:
    """The modules of each entry: those in code at the beginning of a bullet."""
    bullets = re.findall(r"^- ([^:]*):", page, re.M)
    return [found for bullet in bullets if (found := _LISTED.findall(bullet))]


def names(module: ModuleType) -> list[str]:
    """A module's public names: `__all__`, or else the classes and functions that it defines."""
    if hasattr(module, "__all__"):
        return sorted(module.__all__, key=str.lower)
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and _has_a_name(value) and value.__module__ == module.__name__
    ]


def _has_a_name(value: Any) -> bool:
    return inspect.isclass(value) or inspect.isroutine(value)


def pages(listed: list[list[str]]) -> dict[str, str]:
    """Each entry's page as reStructuredText, by the name of its first module."""
    documented: dict[int, str] = {}
    by_depth = sorted(chain.from_iterable(listed), key=lambda name: name.count("."))
    parts = {name: _page(importlib.import_module(name), documented) for name in by_depth}
    return {entry[0]: "\n".join(map(parts.__getitem__, entry)) for entry in listed}


def _page(module: ModuleType, documented: dict[int, str]) -> str:
    lines = [module.__name__, "=" * len(module.__name__), ""]
    lines += [f".. automodule:: {module.__name__}", "   :no-members:", ""]
    links = []
    for name in names(module):
        value = getattr(module, name)
        path = f"{module.__name__}.{name}"
        if _has_a_name(value) and id(value) in documented:
            aliases[path] = documented[id(value)]
            links.append(f":py:obj:`{name} <{aliases[path]}>`")
        elif not inspect.ismodule(value):
            documented[id(value)] = path
            lines += _directive(path, value)
    if links:
        lines += [f"Documented elsewhere, importable from here too: {', '.join(links)}.", ""]
    return "\n".join(lines)


def _directive(path: str, value: Any) -> list[str]:
    if inspect.isclass(value) and issubclass(value, BaseException):
        return [f".. autoexception:: {path}", "   :show-inheritance:", ""]
    if inspect.isclass(value):
        options = ["   :members:", "   :member-order: bysource", "   :show-inheritance:"]
        options += ["   :exclude-members: model_config"]
        return [f".. autoclass:: {path}", *options, ""]
    if typing.get_origin(value) is not None:
        return [f".. py:type:: {path}", "", f"   {_alias(value)}", ""]
    kind = "function" if inspect.isroutine(value) else "data"
    return [f".. auto{kind}:: {path}", ""]


def _alias(value: Any) -> str:
    """What a type alias stands for: its description, or the type itself."""
    for mark in getattr(value, "__metadata__", ()):
        if isinstance(mark, FieldInfo) and mark.description:
            return f"{stringify_annotation(value.__origin__, 'smart')}: {mark.description}."
    if hasattr(value, "__metadata__"):
        value = value.__origin__
    return f"``{short_types(stringify_annotation(value, 'smart')).replace('~', '')}``"


def write(source: Path) -> None:
    """Write the pages below the folder of the sources; files that did not change are left alone."""
    listed = modules((source / f"{PAGE}.md").read_text(encoding="utf-8"))
    folder = source / PAGE
    folder.mkdir(exist_ok=True)
    texts = {folder / f"{name}.rst": text for name, text in pages(listed).items()}
    for path in set(folder.glob("*.rst")) - texts.keys():
        path.unlink()
    for path, text in texts.items():
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            write_atomically(path, text)


def _on_read(app: Sphinx, name: str, source: list[str]) -> None:
    if name == PAGE:
        below = "\n".join(f"python/{entry[0]}" for entry in modules(source[0]))
        source[0] += f"\n```{{toctree}}\n:hidden:\n\n{below}\n```\n"


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("config-inited", lambda app, _config: write(Path(app.srcdir)))
    app.connect("source-read", _on_read)
    return {"parallel_read_safe": True}
