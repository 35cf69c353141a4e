"""The tree of pages: an `index.md` contains the pages of its folder, in the order of its links.

So a list of links, which also reads well on GitHub, is all that a new page needs. Sphinx warns of a
page that no `index.md` links to.
"""

from __future__ import annotations

import posixpath
import re

from sphinx.application import Sphinx

_LINK = re.compile(r"\]\((?P<path>[^):#]+)\.md(?:#[^)]*)?\)")


def members(text: str, front: bool = False) -> list[str]:
    """The pages that an index contains: its links into its own folder, each once.

    Args:
      text: the index, in Markdown.
      front: whether it is the front page, which contains the indexes of the folders below.
    """
    pages = [link["path"] for link in _LINK.finditer(text)]
    below = (page for page in pages if not page.startswith("../"))
    if front:
        below = (page for page in below if posixpath.basename(page) == "index")
    return list(dict.fromkeys(below))


def _on_read(app: Sphinx, name: str, source: list[str]) -> None:
    if posixpath.basename(name) == "index":
        pages = members(source[0], front=name == app.config.root_doc)
        source[0] += "\n\n```{toctree}\n:hidden:\n\n" + "\n".join(pages) + "\n```\n"


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("source-read", _on_read)
    return {"parallel_read_safe": True}
