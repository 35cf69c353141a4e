"""Links that work on GitHub work on the site as well.

- The front page begins with the repository's README, with its links into `docs/`.
- A link to a page outside `docs/` that the site contains (`_PAGES`) leads there. MyST makes a link
  to any other file a download. A folder cannot be downloaded: its link becomes plain text.
- A link whose text is a file's name, such as `[teams.md](teams.md)`, has the page's title as its
  text: the site has no such file.
- A notebook has a link to itself as a file.
"""

from __future__ import annotations

import json
import posixpath
import re
from pathlib import Path

from sphinx.application import Sphinx

_PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "project/changelog.md",
    "CONTRIBUTING.md": "project/contributing.md",
}
_FROM_ROOT = re.compile(r"\]\((?!https?:|#)(docs/)?([^)]*)\)")
_FILE_NAME = re.compile(r"(?<!!)\[[\w/-]+\.md\](?=\([^):\s]+\))")
_LINK = re.compile(r"(?<!!)\[(?P<text>[^\]]*)\]\((?P<path>\.\./[^)#\s]*)(?P<anchor>#[^)\s]*)?\)")


def rewrite(text: str, folder: str, root: Path) -> str:
    """The Markdown of a page with its links made links of the site.

    Args:
      text: Markdown.
      folder: the page's folder, relative to `docs/`, with slashes.
      root: the folder of `docs/`.
    """

    def replaced(link: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join("docs", folder, link["path"]))
        if path in _PAGES:
            page = posixpath.relpath(_PAGES[path], folder or ".")
            return f"[{link['text']}]({page}{link['anchor'] or ''})"
        return link["text"] if (root.parent / path).is_dir() else link[0]

    return _FILE_NAME.sub("[]", _LINK.sub(replaced, text))


def front(readme: str) -> str:
    """The README as a page of `docs/`: its links are relative to the repository's root."""
    return _FROM_ROOT.sub(lambda link: f"]({'' if link[1] else '../'}{link[2]})", readme)


def rewrite_notebook(text: str, name: str, root: Path) -> str:
    """A notebook with the links of its Markdown made links of the site, and one to its file."""
    folder, file = posixpath.split(name)
    notebook = json.loads(text)
    for cell in notebook["cells"]:
        if cell["cell_type"] == "markdown":
            cell["source"] = rewrite("".join(cell["source"]), folder, root)
    download = f"\n\n{{download}}`Download this page as a notebook <{file}.ipynb>`"
    notebook["cells"][0]["source"] += download
    return json.dumps(notebook)


def _on_read(app: Sphinx, name: str, source: list[str]) -> None:
    root = Path(app.srcdir)
    if app.env.doc2path(name).suffix == ".ipynb":
        source[0] = rewrite_notebook(source[0], name, root)
        return
    if name == app.config.root_doc:
        source[0] = front((root.parent / "README.md").read_text(encoding="utf-8")) + source[0]
    source[0] = rewrite(source[0], posixpath.dirname(name), root)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("source-read", _on_read, priority=400)
    return {"parallel_read_safe": True}
