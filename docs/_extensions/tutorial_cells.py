"""Tutorials: plain Markdown whose blocks of code are executed when the site is built.

In a page of `docs/tutorials/`, each block

    ```python   is a cell,
    ```sh       is a cell that runs its lines in a shell (`%%sh`),

and blocks in any other language stay as they are. So a tutorial reads well on GitHub, its blocks
can be run by a test, and the site shows what they print and draw. A line above a block such as

    <!-- cell: hide-output -->

gives the cell MyST-NB's tags, separated by spaces: `hide-input`, `hide-output`, `remove-output`,
`raises-exception`, `skip-execution` and others.
"""

from __future__ import annotations

import re

from sphinx.application import Sphinx

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


def as_notebook(text: str) -> str:
    """A tutorial as a MyST text notebook; unchanged if it has no block to execute."""
    cells, count = _BLOCK.subn(_cell, text)
    return _HEADER + cells if count else text


def _cell(block: re.Match[str]) -> str:
    tags = f":tags: [{', '.join(block['tags'].split())}]\n" if block["tags"] else ""
    shell = "%%sh\n" if block["language"] == "sh" else ""
    return f"```{{code-cell}} python3\n{tags}{shell}{block['code']}```"


def _on_read(app: Sphinx, name: str, source: list[str]) -> None:
    if name.startswith(FOLDER):
        source[0] = as_notebook(source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("source-read", _on_read)
    return {"parallel_read_safe": True}
