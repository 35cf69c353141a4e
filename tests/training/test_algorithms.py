"""Names of algorithms."""

from __future__ import annotations

import pytest

from sme_registry.training import ALGORITHMS
from sme_registry.training.algorithms import known_algorithm


@pytest.mark.parametrize("name", list(ALGORITHMS))
def test_algorithms_are_known_in_any_case(name: str) -> None:
    assert known_algorithm(name.lower()) == name
