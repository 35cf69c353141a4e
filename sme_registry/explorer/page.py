"""The page: one HTML file that carries its data and its script, and loads nothing.

Text from outside is only ever in the data, which is JSON in which `<`, `>` and `&` are escaped; the
script puts it on the page as text. A content security policy allows this script and this style by
their hashes, and nothing else: no other code, and no network.
"""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path
from typing import Any

from markupsafe import Markup

from sme_registry.io.markup import environment
from sme_registry.version import __version__

__all__ = ["STATIC", "page"]

_ASSETS = Path(__file__).parent / "assets"
_ESCAPES = {
    "<": "\\u003c",
    ">": "\\u003e",
    "&": "\\u0026",
    "\u2028": "\\u2028",
    "\u2029": "\\u2029",
}


def page(facts: dict[str, Any], static: str = "") -> str:
    """The page of some facts; equal facts give equal pages."""
    title = f"{facts['name']} on {facts['title']}" if facts["name"] else facts["title"]
    script, style = STATIC["explorer.js"], STATIC["explorer.css"]
    sources = ("'self' file:",) * 2 if static else tuple(f"'{_hash(x)}'" for x in (script, style))
    return (
        environment(_ASSETS, autoescape=True)
        .get_template("page.html.jinja")
        .render(
            title=title,
            kind="Policy and task" if facts["name"] else "Task",
            version=__version__,
            data=Markup(json_in_html(facts)),
            static=static,
            script=Markup(script),
            script_source=Markup(sources[0]),
            style=Markup(style),
            style_source=Markup(sources[1]),
        )
    )


def json_in_html(data: Any) -> str:
    """Data as JSON that no text in it can end, inside a `<script>` element."""
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    for letter, escaped in _ESCAPES.items():
        text = text.replace(letter, escaped)
    return text


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


STATIC = {
    # One strict function, so that the files share names and add none to the page but `explorer`.
    "explorer.js": '(function () {\n"use strict";\n'
    + "\n".join(map(_asset, ("equations.js", "charts.js", "explorer.js")))
    + "})();\n",
    "explorer.css": _asset("explorer.css"),
}
"""The script and the style of every page, by name."""
