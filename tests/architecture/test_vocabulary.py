"""One name for one quantity: every number in a document is named in `tests/vocabulary.py`."""

from __future__ import annotations

import importlib
import pkgutil
from typing import get_args

import pytest
from pydantic import BaseModel

import leaderboard
import sme_registry
from sme_registry.spec import StudyFile, catalogue
from sme_registry.spec.document import Real, StrictModel
from tests.vocabulary import QUANTITIES, SYNONYMS


def documents():
    """Every document and part of one, in both packages."""
    for package in (sme_registry, leaderboard):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)

    def below(model):
        for kind in model.__subclasses__():
            yield kind
            yield from below(kind)

    ours = {
        kind
        for kind in below(StrictModel)
        if kind.__module__.split(".")[0] in ("sme_registry", "leaderboard")
        and ".jax." not in kind.__module__  # hyperparameters with Stable-Baselines3's names
    }
    return sorted(ours, key=lambda kind: (kind.__module__, kind.__name__))


def holds_numbers(annotation):
    """Whether values of a type are numbers, estimates of numbers, or collections of either."""
    if annotation in (int, float):
        return True
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "value" in annotation.model_fields and "high" in annotation.model_fields
    return any(holds_numbers(part) or type(part) is int for part in get_args(annotation))


def numbers(model):
    """The fields of a document that hold numbers."""
    return [name for name, field in model.model_fields.items() if holds_numbers(field.annotation)]


def unnamed(model):
    """What is wrong with the names of a document's fields."""
    return [
        *(f"{name}: not in tests/vocabulary.py" for name in numbers(model)
          if name not in QUANTITIES),
        *(f"{name}: is {SYNONYMS[name]}" for name in model.model_fields
          if name in SYNONYMS and name in numbers(model)),
    ]  # fmt: skip


def test_every_number_in_a_document_has_the_name_of_its_quantity():
    models = documents()
    assert len(models) > 100
    assert {model.__qualname__: names for model in models if (names := unnamed(model))} == {}


def columns():
    """The columns of numbers in episodes.csv and in a study's data frames."""
    pytest.importorskip("pandas")
    from sme_registry.studies.report.frames import stream_frames, study_frames
    from sme_registry.training.record import COLUMNS

    frames = [*study_frames(catalogue.entries(StudyFile)[0].plan, {}), *stream_frames([])]
    numeric = {name for frame in frames for name in frame.select_dtypes("number").columns}
    assert {"normalised_regret", "episode_return"} < numeric
    return numeric | set(COLUMNS)


def test_every_column_of_numbers_has_the_name_of_its_quantity():
    assert columns() - QUANTITIES.keys() == set()


def test_a_new_synonym_is_noticed():
    class Planted(BaseModel):
        similarity: Real
        decay: Real
        profile: tuple[Real, ...]
        mean_error: Real | None = None
        note: str = ""

    assert unnamed(Planted) == [
        "decay: not in tests/vocabulary.py",
        "profile: not in tests/vocabulary.py",
        "mean_error: not in tests/vocabulary.py",
        "decay: is ood_decay or similarity_decay",
        "profile: is normalised_regret",
    ]


def test_the_vocabulary_has_no_unused_name():
    used = {name for model in documents() for name in numbers(model)}
    assert set(QUANTITIES) - used - columns() == set()
    assert not QUANTITIES.keys() & SYNONYMS.keys()
