"""Names in code, such as `sme_registry.evaluate` and `sme study run`, link to their reference.

The sources need no markup for it, so on GitHub they are plain code.
"""

from __future__ import annotations

import re

import python_reference
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.nodes import make_refnode

_COMMAND = re.compile(r"sme(-leaderboard)?( [a-z][a-z-]*)+")
_NAME = re.compile(r"((?:sme_registry|leaderboard)[\w.]*)(?:\(.*\))?")  # perhaps called


class LinkCode(SphinxPostTransform):
    """Wraps inline code that names a documented object or command in a link."""

    default_priority = 5

    def run(self, **kwargs: object) -> None:
        """Replace each such literal of the page."""
        for literal in list(self.document.findall(nodes.literal)):
            target = None if isinstance(literal.parent, nodes.reference) else self._target(literal)
            if target and self.env.docname != target[0]:
                here = self.env.docname
                link = make_refnode(self.app.builder, here, *target, literal.deepcopy())
                literal.replace_self(link)

    def _target(self, literal: nodes.literal) -> tuple[str, str] | None:
        text = literal.astext()
        if _COMMAND.fullmatch(text):
            label = self.env.domains.standard_domain.anonlabels.get(text.replace(" ", "-"))
            return label[:2] if label else None
        if found := _NAME.fullmatch(text):
            domain = self.env.domains.python_domain
            name = python_reference.aliases.get(found[1], found[1])
            if name in domain.objects:
                return domain.objects[name].docname, domain.objects[name].node_id
            if name in domain.modules:
                return domain.modules[name].docname, domain.modules[name].node_id
        return None


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_post_transform(LinkCode)
    return {"parallel_read_safe": True}
