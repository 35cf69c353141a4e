"""The site's own extensions: what they make of a page, a docstring, a command, a schema."""

import importlib
import inspect
import re

import nbclient
import nbformat
import pytest

from tests.docs.conftest import ROOT

pytest.importorskip("sphinx")

import command_reference
import docstrings
import links
import python_reference
import schema_files
import tutorial_cells
from docutils import nodes
from docutils.utils import new_document

import sme_registry
from sme_registry.cli.show import _SCHEMAS

TUTORIAL = """# Title

<!-- extras: plot, train -->

See [teams](../guides/teams.md) and [a site](https://example.org).

```python
x = 1
```

<!-- cell: hide-output -->
```sh
sme list
```

```text
not run
```
"""


def test_blocks_of_a_tutorial_are_cells_and_others_stay():
    page = tutorial_cells.as_page(TUTORIAL, "name")
    assert "```{code-cell} python3\nx = 1\n```" in page
    assert "```{code-cell} python3\n:tags: [hide-output]\n%%sh -e\nsme list\n```" in page
    assert "```text\nnot run\n```" in page
    assert page.startswith("---\n")
    assert tutorial_cells.as_page("# No code\n\n```text\n```\n", "name").startswith("# No code")


def test_a_tutorial_as_a_notebook_installs_first_and_has_the_same_cells():
    notebook = tutorial_cells.as_notebook(TUTORIAL)
    nbformat.validate(notebook)
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    assert '%pip install --quiet "sme-registry[plot,train] @ {address}"' in code[0]
    assert code[1:] == ["x = 1", "%%sh -e\nsme list"]
    text = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    assert "See teams and [a site](https://example.org)." in text
    assert "<!--" not in text
    assert nbformat.writes(notebook) == nbformat.writes(tutorial_cells.as_notebook(TUTORIAL))


def test_long_lines_of_a_shell_stay_whole():
    class App:
        def connect(self, *_, **__):
            pass

    tutorial_cells.setup(App())
    cell = nbformat.v4.new_code_cell("%%sh\nprintf '%0500d\\n' 7 8")
    notebook = nbformat.v4.new_notebook(cells=[cell])
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    (output,) = notebook.cells[0].outputs
    assert output.text == f"{7:0500}\n{8:0500}\n"


def test_shell_cells_are_shown_as_they_are_typed_in_a_terminal():
    code = [nodes.literal_block(text, text) for text in ("%%sh -e\nsme list", "x = '%%sh -e'")]
    page = new_document("page")
    page += code
    tutorial_cells._on_doctree(None, page)
    shell, python = page.children
    assert (shell.astext(), shell["language"]) == ("sme list", "sh")
    assert python is code[1]


def test_links_out_of_docs_lead_to_pages_of_the_site_or_nowhere():
    def rewritten(text):
        return links.rewrite(text, "guides", ROOT / "docs")

    assert (
        rewritten("[c](../../CONTRIBUTING.md#checks)") == "[c](../project/contributing.md#checks)"
    )
    assert rewritten("[board](../../examples/board)") == "board"
    same = "[ope](../../examples/ope.py), ![x](../../x.png), [m](../explanation/method.md)"
    assert rewritten(same) == same
    assert rewritten("[teams.md](teams.md#a) says") == "[](teams.md#a) says"


def test_the_front_page_is_the_readme_with_its_links_from_docs():
    text = "[m](docs/m.md#a) ![f](docs/f.png) [c](CITATION.cff) [p](https://a.org) [i](#install)"
    assert links.front(text) == (
        "[m](m.md#a) ![f](f.png) [c](../CITATION.cff) [p](https://a.org) [i](#install)"
    )


def test_a_docstring_becomes_rst_with_its_formulas_and_doctests_untouched():
    text = "Mean |a| of `x*` and\n`y`s.\n\n    a* = b |c|\n\nThen π* is.\n\n>>> f(*x)\n3"
    assert docstrings.as_rst(text.split("\n")) == [
        r"Mean \|a\| of ``x*`` and", r"``y``\ s.", "", "::", "", "    a* = b |c|", "",
        r"Then π\* is.", "", ">>> f(*x)", "3",
    ]  # fmt: skip


def test_every_command_and_option_is_in_the_reference():
    sme = command_reference.page("sme", "sme_registry.cli")
    assert "(sme-study-compare)=\n### sme study compare" in sme
    assert r"`-k, --kind <env\|stream\|suite\|protocol\|study>`" in sme
    assert "sme study compare runs/smoke PPO TD3" in sme
    board = command_reference.page("sme-leaderboard", "leaderboard.cli")
    assert "(sme-leaderboard-submit)=\n## sme-leaderboard submit" in board


def test_every_document_with_a_json_schema_has_a_file():
    page = (ROOT / "docs" / "reference" / "generated" / "files.md").read_text()
    listed = re.findall(r"^(?:sme_registry|leaderboard)\.\S+$", page, re.M)
    assert {schema_files.document(path) for path in listed} >= set(_SCHEMAS.values())


def test_every_public_module_is_on_the_page_of_python_names():
    page = (ROOT / "docs" / "reference" / "python.md").read_text()
    listed = {name for entry in python_reference.modules(page) for name in entry}
    public = [f"sme_registry.{name}" for name in sme_registry._SUBMODULES]
    assert listed >= {"sme_registry", *public}


@pytest.mark.parametrize("module", ["sme_registry", "sme_registry.errors", "sme_registry.spec"])
def test_every_public_name_is_documented_once_and_linked_elsewhere(module):
    listed = [["sme_registry"], ["sme_registry.errors"], ["sme_registry.spec"]]
    pages = python_reference.pages(listed)
    owner = importlib.import_module(module)
    for name in python_reference.names(owner):
        value = getattr(owner, name)
        if inspect.ismodule(value):
            continue
        at_home = re.search(rf":: {re.escape(module)}\.{name}$", pages[module], re.M)
        assert bool(at_home) != (f":py:obj:`{name} <" in pages[module]), name
    everything = "\n".join(pages.values())
    assert len(re.findall(r":: \S+\.SMESpec$", everything, re.M)) == 1
