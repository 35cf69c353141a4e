"""Hyperparameters: their names, their values, and those that several lanes need."""

import pytest

from sme_registry.errors import OptionError
from sme_registry.training.algorithms import (
    check_hyperparameters,
    nested_hyperparameters,
)

pytest.importorskip("stable_baselines3")


def test_dotted_names_are_nested():
    flat = {"gamma": 0.9, "policy_kwargs.net_arch": [64, 64], "policy_kwargs.n_critics": 1}
    assert nested_hyperparameters(flat) == {
        "gamma": 0.9,
        "policy_kwargs": {"net_arch": [64, 64], "n_critics": 1},
    }
    given = {"policy_kwargs": {"net_arch": [64]}, "policy_kwargs.n_critics": 1}
    assert nested_hyperparameters(given)["policy_kwargs"] == {"net_arch": [64], "n_critics": 1}
    assert given["policy_kwargs"] == {"net_arch": [64]}


@pytest.mark.parametrize(
    "flat", [{"a": 1, "a.b": 2}, {"a.b": 2, "a": 1}, {"a.": 1}, {".a": 1}, {"a": 1, "a.b.c": 2}]
)
def test_names_that_cannot_be_nested_are_rejected(flat):
    with pytest.raises(OptionError, match="one name for each value"):
        nested_hyperparameters(flat)


@pytest.mark.parametrize(
    ("uses", "values", "message"),
    [
        ("PPO", {"n_stepz": 64}, r"hyperparameters\.n_stepz: PPO has .*Did you mean 'n_steps'"),
        ("td3", {"policy_kwargs": {"net_arhc": [8]}}, r"policy_kwargs\.net_arhc=.*'net_arch'"),
        ("PPO", {"tensorboard_log": "logs"}, "has no such hyperparameter"),
        ("sb3_contrib:TQC", {"top_quantiles": 1}, "top_quantiles_to_drop_per_net"),
    ],
)
def test_unknown_names_are_rejected_with_a_similar_one(uses, values, message):
    with pytest.raises(OptionError, match=message):
        check_hyperparameters(uses, values)


def test_a_field_of_the_task_may_have_been_meant():
    pytest.importorskip("jax")
    others = ["action_dim", "complexity"]
    for uses in ("jax:TD3", "TD3"):
        with pytest.raises(OptionError, match=rf"{uses} has no .*Did you mean 'complexity'"):
            check_hyperparameters(uses, {"complexty": 2}, others=others)
