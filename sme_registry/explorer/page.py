"""The page: one HTML file that carries its data and its script, and loads nothing.

Text from outside is only ever in the data, which is JSON in which `<`, `>` and `&` are escaped; the
script puts it on the page as text. A content security policy allows this script and this style by
their hashes, and nothing else: no other code, and no network.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from sme_registry.diagnosis.subject import AnySubject, StreamSubject, cell_path
from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport
from sme_registry.explorer.collect import EPISODES, facts
from sme_registry.io import read_json, write_atomically
from sme_registry.io.markup import environment
from sme_registry.spec import SMESpec
from sme_registry.training import EXPLORER as FILE
from sme_registry.training.reports import EVALUATION
from sme_registry.version import __version__

__all__ = ["FILE", "STATIC", "explorer_page", "run_report", "write_explorer"]

_ASSETS = Path(__file__).parent / "assets"
_ESCAPES = {
    "<": "\\u003c",
    ">": "\\u003e",
    "&": "\\u0026",
    "\u2028": "\\u2028",
    "\u2029": "\\u2029",
}


def write_explorer(
    path: str | os.PathLike[str],
    shown: SMESpec | AnySubject,
    *,
    report: EvaluationReport | None = None,
    channels: Sequence[tuple[int, int]] = (),
    episodes: int = EPISODES,
    seed: int = 0,
) -> Path:
    """Write a page completely or not at all; equal arguments give equal bytes."""
    if Path(path).suffix != ".html":
        raise OptionError(f"{os.fspath(path)}: must end in .html.")
    content = explorer_page(shown, report=report, channels=channels, episodes=episodes, seed=seed)
    return write_atomically(path, content)


def explorer_page(
    shown: SMESpec | AnySubject,
    *,
    report: EvaluationReport | None = None,
    channels: Sequence[tuple[int, int]] = (),
    episodes: int = EPISODES,
    seed: int = 0,
    static: str = "",
    remark: str = "",
) -> str:
    """The page of a task, or of a policy on its task, as HTML; equal arguments give equal text.

    `channels` are pairs of inputs, from 1 (state channels, then distractors), over which a policy
    whose network is unknown is sampled. `static` is the address of a folder with the files of
    `STATIC`, relative to the page, for a site that forbids inline code; a page without it needs no
    other file. `remark` is a text above the map.
    """
    if isinstance(shown, StreamSubject):
        raise OptionError(
            f"run={shown.name!r}: is a life in a stream, and an explorer shows one policy on one "
            "task. Give the model of one visit, such as RUN/snapshots/visit-0.zip, with --task "
            "FILE, the task of its phase."
        )
    spec, subject = (shown, None) if isinstance(shown, SMESpec) else (shown.spec, shown)
    content = facts(
        spec,
        subject,
        report=report,
        channels=channels,
        episodes=episodes,
        seed=seed,
        remark=remark,
    )
    return _page(content, static)


def run_report(folder: str | os.PathLike[str], cell: str | None = None) -> EvaluationReport | None:
    """The evaluation of a run's folder, or of a finished cell of a study; None if there is none."""
    if cell is not None:
        result = read_json(cell_path(Path(folder), cell))
        return EvaluationReport.from_dict(result["report"]) if "report" in result else None
    path = Path(folder) / EVALUATION
    return EvaluationReport.read(path) if path.exists() else None


def _page(data: dict[str, Any], static: str) -> str:
    title = f"{data['name']} on {data['title']}" if data["name"] else data["title"]
    script, style = STATIC["explorer.js"], STATIC["explorer.css"]
    sources = ("'self' file:",) * 2 if static else tuple(f"'{_hash(x)}'" for x in (script, style))
    return (
        environment(_ASSETS, autoescape=True)
        .get_template("page.html.jinja")
        .render(
            title=title,
            kind="Policy and task" if data["name"] else "Task",
            version=__version__,
            data=Markup(json_in_html(data)),
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
