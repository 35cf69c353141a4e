"""Checks of arguments, and the versions that documents record."""

import platform
import sys

import numpy as np
import pytest

import sme_registry
from sme_registry.errors import OptionError, PolicyError
from sme_registry.io import choice, integer_in, number_in, versions


@pytest.mark.parametrize("value", [1, 7, np.int64(3), np.uint8(1)])
def test_an_integer_in_its_range_comes_back_as_an_int(value):
    assert type(integer_in("jobs", value, 1, 7)) is int


@pytest.mark.parametrize("value", [0, 8, 1.0, True, np.bool_(1), "3", None, np.ones(2, int)])
def test_any_other_value_is_refused_with_name_value_and_range(value):
    with pytest.raises(OptionError) as caught:
        integer_in("jobs", value, 1, 7, advice="Leave it out for 1.")
    assert str(caught.value) == (
        f"jobs={value!r}: must be an integer in [1, 7]. Leave it out for 1."
    )


def test_an_integer_without_upper_limit_and_another_type_of_error():
    assert integer_in("seed", 2**70, 0) == 2**70
    with pytest.raises(PolicyError, match=r"^seed=-1: must be an integer of at least 0\.$"):
        integer_in("seed", -1, 0, error=PolicyError)


@pytest.mark.parametrize("value", [0, 1, 0.25, np.float32(0.5), np.int64(1)])
def test_a_number_in_its_range_comes_back_as_a_float(value):
    assert type(number_in("cost_limit", value, 0.0, 1.0)) is float


@pytest.mark.parametrize("value", [-0.1, 1.5, np.nan, np.inf, True, "0.5", None, np.bool_(1)])
def test_any_other_number_is_refused_with_name_value_and_range(value):
    with pytest.raises(OptionError) as caught:
        number_in("cost_limit", value, 0.0, 1.0, advice="Leave it out.")
    assert str(caught.value) == (
        f"cost_limit={value!r}: must be a finite number in [0, 1]. Leave it out."
    )


def test_a_number_without_upper_limit():
    assert number_in("multiplier", 1e9, 0.0) == 1e9
    with pytest.raises(OptionError, match=r"^multiplier=-1: must be a finite number of at least 0"):
        number_in("multiplier", -1, 0.0)


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
