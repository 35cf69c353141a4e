"""Checks of arguments, and the versions that documents record."""

import math
import platform
import sys

import numpy as np
import pytest

import sme_registry
from sme_registry.errors import OptionError, PolicyError
from sme_registry.io import choice, integer_in, number_in, versions


def test_an_integer_or_a_number_in_its_range_comes_back_as_pythons():
    for value in (1, 7, np.int64(3), np.uint8(1)):
        assert type(integer_in("jobs", value, 1, 7)) is int
    for value in (0, 1, 0.25, np.float32(0.5), np.int64(1)):
        assert type(number_in("cost_limit", value, 0.0, 1.0)) is float
    assert integer_in("seed", 2**70, 0) == 2**70
    assert number_in("multiplier", 1e9, 0.0) == 1e9


@pytest.mark.parametrize(
    ("check", "low", "high", "allowed", "values"),
    [
        (integer_in, 1, 7, "an integer in [1, 7]", [0, 8, 1.0, np.ones(2, int)]),
        (integer_in, 0, None, "an integer of at least 0", [-1, 1.0]),
        (number_in, 0.0, 1.0, "a finite number in [0, 1]", [-0.1, 1.5, np.nan, np.inf]),
        (number_in, 0.0, math.inf, "a finite number of at least 0", [-1, np.inf]),
    ],
)
def test_any_other_value_is_refused_with_name_value_and_range(check, low, high, allowed, values):
    for value in (*values, True, np.bool_(1), "3", None):
        with pytest.raises(OptionError) as caught:
            check("x", value, low, high, advice="Leave it out.")
        assert str(caught.value) == f"x={value!r}: must be {allowed}. Leave it out."
    with pytest.raises(PolicyError, match=r"^seed=-1: must be an integer of at least 0\.$"):
        integer_in("seed", -1, 0, error=PolicyError)


def test_a_choice_is_one_of_the_names_and_a_near_miss_is_suggested():
    assert choice("action_range", "unit", ("unit", "symmetric")) == "unit"
    with pytest.raises(OptionError) as caught:
        choice("action_range", "symetric", ("unit", "symmetric"))
    assert str(caught.value) == (
        "action_range='symetric': must be 'unit' or 'symmetric'. Did you mean 'symmetric'?"
    )
    for value in (None, 1, ["unit"]):
        with pytest.raises(OptionError, match="must be 'unit' or 'symmetric'"):
            choice("action_range", value, ("unit", "symmetric"))


def test_versions_are_of_what_is_installed():
    assert versions(["numpy", "no-such-package", ""], if_imported=["scipy", "antigravity"]) == {
        "sme_registry": sme_registry.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        **({"scipy": versions(["scipy"])["scipy"]} if "scipy" in sys.modules else {}),
    }
