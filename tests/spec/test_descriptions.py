"""Every field of a public document is described once: for `help`, JSON Schema and documentation."""

import importlib
import inspect
import pkgutil
import pydoc
import re
from typing import Annotated

import pytest
from pydantic import Field

import sme_registry
from sme_registry.spec import Integer, SMESpec, StrictModel
from sme_registry.spec.descriptions import allowed, summary
from sme_registry.spec.validation_errors import allowed_values


def public_documents():
    """The documents that a package of `sme_registry` exports."""
    found = set()
    for module in pkgutil.walk_packages(sme_registry.__path__, "sme_registry."):
        if module.ispkg and ".jax" not in module.name:
            package = importlib.import_module(module.name)
            things = (getattr(package, name) for name in getattr(package, "__all__", ()))
            found |= {
                thing
                for thing in things
                if inspect.isclass(thing) and issubclass(thing, StrictModel)
            }
    return sorted(found, key=lambda kind: kind.__qualname__)


DOCUMENTS = public_documents()
assert len(DOCUMENTS) > 40


@pytest.mark.parametrize("kind", DOCUMENTS, ids=lambda kind: kind.__name__)
def test_every_field_is_described_in_help_and_schema_with_one_text_and_range(kind):
    root = kind.model_json_schema()
    schema = root["$defs"][kind.__name__] if "$ref" in root else root
    assert "Attributes:" not in schema.get("description", "")
    for name, field in kind.model_fields.items():
        entry = schema["properties"][name]
        assert field.description, name
        assert entry["description"] == field.description
        shown = re.search(rf"^  {name}: ((?:.|\n    )*)", kind.__doc__, re.M)
        assert shown, name
        assert " ".join(shown[1].split()).startswith(field.description), name
        options = [
            option for each in entry.get("anyOf", [entry]) for option in each.get("anyOf", [each])
        ]
        words = [
            f"`{option['$ref'].rpartition('/')[2]}`"
            if "$ref" in option
            else allowed_values(root, option)
            for option in options
        ]
        assert allowed(field) == " or ".join(words), name


def test_help_shows_symbol_range_default_and_meaning_of_inherited_fields_too():
    text = pydoc.render_doc(SMESpec, renderer=pydoc.plaintext)
    flat = " ".join(re.sub(r"^ \|", "", text, flags=re.M).split())
    assert "state_dim: S, state channels. An integer in [1, 1048576]; default: 8." in flat
    assert "seed: of all random draws of the task. An integer in [0, 9007199254740992)" in flat
    assert "team: divides the action channels" in flat
    assert "`TeamSpec` or null; default: null." in flat


def test_ranges_follow_from_the_fields():
    class Tuned(StrictModel):
        """A document.

        Attributes:
          first, second: of two.

        Examples:
          none
        """

        first: Annotated[Integer, Field(ge=3, lt=7)] = 4
        second: bool

    assert summary(Tuned) == "A document."
    assert Tuned.__doc__ == (
        "A document.\n\nAttributes:\n  first: of two.\n    An integer in [3, 7); default: 4.\n"
        "  second: of two.\n    True or false.\n\nExamples:\n  none\n"
    )
    assert Tuned(second=True).__doc__ == Tuned.__doc__
