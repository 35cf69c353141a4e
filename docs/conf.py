"""The site's settings: `make docs` builds it into `docs/_build/html`."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE / "_extensions")]

from sme_registry.version import __version__  # noqa: E402

project = "SME Registry"
author = "The SME Registry developers"
copyright = author
version = release = __version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
    "code_links",
    "command_reference",
    "docstrings",
    "links",
    "python_reference",
    "schema_files",
]
exclude_patterns = [
    "_build", "_extensions", "**/.ipynb_checkpoints",
    "reference/generated/codes.md",  # a part of the page of the command
]  # fmt: skip

# Markdown: the sources are read on GitHub too, so only what GitHub also shows.
myst_enable_extensions = ["colon_fence", "attrs_block"]
myst_heading_anchors = 4  # headings have the anchors that GitHub gives them
myst_links_external_new_tab = False

nb_execution_mode = "off"  # tutorials have stored outputs: see docs/notebooks.py

smartquotes = False  # what is quoted may be JSON to type, and two hyphens begin an option
highlight_language = "text"  # of blocks without a language

html_theme = "furo"
html_title = f"SME Registry {release}"
html_static_path = ["_static"]
html_favicon = "../leaderboard/web/static/icon.svg"
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
pygments_style = "default"
pygments_dark_style = "github-dark"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_class_signature = "mixed"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
