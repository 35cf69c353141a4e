"""Hyperparameters: their names, their values, and those that several lanes need."""

import pytest

from sme_registry.errors import OptionError
from sme_registry.training.algorithms import (
    check_hyperparameters,
    nested_hyperparameters,
)

pytest.importorskip("stable_baselines3")


@pytest.mark.parametrize(
    "flat", [{"a": 1, "a.b": 2}, {"a.b": 2, "a": 1}, {"a.": 1}, {".a": 1}, {"a": 1, "a.b.c": 2}]
)
def test_names_that_cannot_be_nested_are_rejected(flat):
    with pytest.raises(OptionError, match="one name for each value"):
        nested_hyperparameters(flat)


def test_a_field_of_the_task_may_have_been_meant():
    pytest.importorskip("jax")
    others = ["action_dim", "complexity"]
    for uses in ("jax:TD3", "TD3"):
        with pytest.raises(OptionError, match=rf"{uses} has no .*Did you mean 'complexity'"):
            check_hyperparameters(uses, {"complexty": 2}, others=others)
