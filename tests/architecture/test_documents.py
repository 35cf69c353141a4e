"""Every document that the packages make public describes its fields."""

import importlib
import inspect
import pkgutil
import re

import pytest

import sme_registry
from sme_registry.spec.document import StrictModel

WRITTEN = {  # into files that users read, by names that no package exports
    "evaluation.regions": (
        *("ChannelReport", "Sensitivity", "LayerProbe", "ObservationReport", "RegionReport"),
        *("SafetyReport", "SafetyScore"),
    ),
    "evaluation.report": ("AgentReport",),
    "datasets.documents": (
        *("BCHyperparameters", "Behaviour", "DatasetRecord", "IQLHyperparameters"),
        "OfflineRecord",
    ),
    "studies.result": ("CellResult",),
    "training.record": ("RunRecord",),
    "spec.document": ("Document", "StrictModel"),
    "spec.study": ("Cell", "PlannedCell"),
    "spec.catalogue": ("Fingerprint",),
}


def public_documents():
    """The documents that a package of `sme_registry` exports, and those in files of users."""
    names = {f"sme_registry.{module}": names for module, names in WRITTEN.items()}
    for module in pkgutil.walk_packages(sme_registry.__path__, "sme_registry."):
        if module.ispkg and ".jax" not in module.name:
            package = importlib.import_module(module.name)
            names[module.name] = getattr(package, "__all__", ())
    things = [
        getattr(importlib.import_module(module), name)
        for module, exported in names.items()
        for name in exported
    ]
    documents = {kind for kind in things if inspect.isclass(kind) and issubclass(kind, StrictModel)}
    return sorted(documents, key=lambda kind: kind.__qualname__)


DOCUMENTS = public_documents()
assert len(DOCUMENTS) > 40


@pytest.mark.parametrize("kind", DOCUMENTS, ids=lambda kind: kind.__name__)
def test_every_field_is_described_in_help_and_schema_with_one_text(kind):
    root = kind.model_json_schema()
    schema = root["$defs"][kind.__name__] if "$ref" in root else root
    assert not re.search("Attributes:|Examples:", schema.get("description", ""))
    for name, field in kind.model_fields.items():
        assert field.description, name
        assert schema["properties"][name]["description"] == field.description
        shown = re.search(rf"^  {name}: ((?:.|\n    )*)", kind.__doc__, re.M)
        assert shown, name
        assert " ".join(shown[1].split()) == field.description, name
