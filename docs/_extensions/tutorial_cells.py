"""Tutorials: plain Markdown whose blocks of code are executed when the site is built.

In a page of `docs/tutorials/`, each block

    ```python   is a cell,
    ```sh       is a cell that runs its lines in a shell, up to one that fails (`%%sh -e`),

and blocks in any other language stay as they are. So a tutorial reads well on GitHub, its blocks
can be run by a test, and the site shows what they print and draw. A line above a block such as

    <!-- cell: hide-output -->

gives the cell MyST-NB's tags, separated by spaces: `hide-input`, `hide-output`, `remove-output`,
`raises-exception`, `skip-execution` and others. The site offers each tutorial as a notebook too,
whose first cell installs the package where it is missing, with the extras that the page names:

    <!-- extras: plot,train -->
    <!-- also: torchrl -->     a package that no extra has
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partialmethod
from pathlib import Path

import nbformat
from docutils import nodes
from nbclient import NotebookClient
from nbformat import NotebookNode, v4
from sphinx.application import Sphinx

from sme_registry.io import write_atomically
from sme_registry.version import __version__

FOLDER = "tutorials/"
_HEADER = """---
file_format: mystnb
kernelspec:
  name: python3
  display_name: Python 3
  language: python
---
"""
_BLOCK = re.compile(
    r"(?:^<!-- cell: (?P<tags>[a-z -]+?) -->\n+)?^```(?P<language>python|sh)\n(?P<code>.*?)^```$",
    re.M | re.S,
)
_EXTRAS = re.compile(r"^<!-- extras: ([a-z, ]+?) -->$", re.M)
_ALSO = re.compile(r"^<!-- also: ([a-z]+) -->$", re.M)
_RELATIVE_LINK = re.compile(r"!?\[([^\]]*)\]\((?!https?:)[^)]*\)")
_SHELL = "%%sh -e\n"
_COMMENT = re.compile(r"^<!--.*?-->\n?", re.M | re.S)
# The rule for readers is in docs/tutorials/installation.md: the package is on no index.
_INSTALL = """# Installs the package where it is missing. Name what you have: the folder of a clone,
# a wheel (sme_registry-{version}-py3-none-any.whl), or a Git address (git+https://…).
SOURCE = "sme-registry"

import importlib.util
import os
import pathlib
import sys

if importlib.util.find_spec("sme_registry") is None:
    path = pathlib.Path(SOURCE).expanduser().resolve()
    if "://" not in SOURCE and not path.exists():
        raise FileNotFoundError(f"{{path}} is missing: set SOURCE to what you have.")
    address = SOURCE if "://" in SOURCE else path.as_uri()
    %pip install --quiet "sme-registry{extras} @ {{address}}"
{also}
# So that cells find the package's commands where the environment of this Python is not active.
os.environ["PATH"] = os.pathsep.join([str(pathlib.Path(sys.executable).parent), os.environ["PATH"]])
"""
_INSTALL_ALSO = """if importlib.util.find_spec("{package}") is None:
    %pip install --quiet {package}
"""


def as_page(text: str, name: str) -> str:
    """A tutorial as a MyST text notebook with a link to its notebook file.

    Args:
      text: the tutorial; unchanged if it has no block to execute.
      name: the file's name without `.md`.
    """
    cells, count = _BLOCK.subn(_cell, text)
    if not count:
        return text
    link = (
        f'\n\n<a href="../notebooks/{name}.ipynb" download>Download this page as a notebook</a>\n'
    )
    title, _, rest = cells.partition("\n")
    return f"{_HEADER}{title}\n{link}{rest}"


def _code(block: re.Match[str]) -> str:
    shell = _SHELL if block["language"] == "sh" else ""
    return shell + block["code"]


def _cell(block: re.Match[str]) -> str:
    tags = f":tags: [{', '.join(block['tags'].split())}]\n" if block["tags"] else ""
    return f"```{{code-cell}} python3\n{tags}{_code(block)}```"


def as_notebook(text: str) -> NotebookNode:
    """A tutorial as a notebook for Jupyter, without outputs."""
    extras = _EXTRAS.search(text)
    also = _ALSO.search(text)
    install = _INSTALL.format(
        version=__version__,
        extras=f"[{extras[1].replace(' ', '')}]" if extras else "",
        also=_INSTALL_ALSO.format(package=also[1]) if also else "",
    )
    title, _, rest = text.partition("\n")
    cells = [v4.new_markdown_cell(title), v4.new_code_cell(install), *_cells(rest)]
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"  # else random: equal pages give equal files
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return v4.new_notebook(cells=cells, metadata={"kernelspec": kernel})


def _cells(text: str) -> Iterator[NotebookNode]:
    end = 0
    for block in _BLOCK.finditer(text):
        yield from _prose(text[end : block.start()])
        yield v4.new_code_cell(_code(block).rstrip("\n"))
        end = block.end()
    yield from _prose(text[end:])


def _prose(text: str) -> Iterator[NotebookNode]:
    """A cell of text: its links to other pages would lead nowhere."""
    if plain := _RELATIVE_LINK.sub(r"\1", _COMMENT.sub("", text)).strip():
        yield v4.new_markdown_cell(plain)


def _on_read(app: Sphinx, name: str, source: list[str]) -> None:
    if name.startswith(FOLDER):
        text, file = source[0], name.removeprefix(FOLDER)
        source[0] = as_page(text, file)
        if source[0] != text:
            folder = Path(app.outdir, "notebooks")
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically(folder / f"{file}.ipynb", nbformat.writes(as_notebook(text)) + "\n")


def _on_doctree(app: Sphinx, doctree: nodes.document) -> None:
    """Show shell cells as a reader types them: the first line is for the kernel."""
    for block in list(doctree.findall(nodes.literal_block)):
        text = block.astext()
        if text.startswith(_SHELL):
            block.replace_self(nodes.literal_block(text, text.removeprefix(_SHELL), language="sh"))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx: before `links`, so that notebooks get the page as it is written."""
    app.connect("source-read", _on_read, priority=300)
    app.connect("doctree-read", _on_doctree)
    # Kernels send what a shell prints in pieces of 100 characters, which MyST-NB joins with line
    # breaks. nbclient can merge them as they were printed, but MyST-NB passes no option on to it.
    create = partialmethod(NotebookClient.__init__, coalesce_streams=True)
    NotebookClient.__init__ = create  # type: ignore[assignment]
    return {"parallel_read_safe": True}
