"""The directive `json-schemas`: writes the JSON Schema of each document it lists, and links to it.

```{json-schemas}
sme_registry.spec.SMESpec
```
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path

from docutils import nodes
from pydantic import BaseModel
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from sme_registry.io import write_atomically


def document(path: str) -> type[BaseModel]:
    """The class of a document by its import path."""
    module, _, name = path.rpartition(".")
    found: type[BaseModel] = getattr(importlib.import_module(module), name)
    return found


class JsonSchemas(SphinxDirective):
    """A list of files, one for each document."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Write the files below `schemas/` of the site, and return the list of links to them."""
        folder = Path(self.env.app.outdir, "schemas")
        folder.mkdir(parents=True, exist_ok=True)
        up = "../" * self.env.docname.count("/")
        items = nodes.bullet_list()
        for kind in map(document, filter(None, self.content)):
            name = f"{kind.__name__}.schema.json"
            schema = json.dumps(kind.model_json_schema(), indent=2, ensure_ascii=False)
            write_atomically(folder / name, schema + "\n")
            link = nodes.reference("", name, refuri=f"{up}schemas/{name}")
            items += nodes.list_item("", nodes.paragraph("", "", link))
        return [items]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_directive("json-schemas", JsonSchemas)
    return {"parallel_read_safe": True}
