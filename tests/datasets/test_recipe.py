"""The recipe of a data set: its digest, its validation and its differences."""

from __future__ import annotations

import numpy as np
import pytest

from sme_registry.datasets import Behaviour, DatasetRecipe
from sme_registry.datasets.recipe import parse_behaviour
from sme_registry.errors import PolicyError, SMEError, SpecError

FIELDS = {"spec": {}, "behaviours": [{"kind": "mixture", "nu": 0.5}]}


def recipe(**changes):
    return DatasetRecipe.from_dict({**FIELDS, **changes})


def weights(*shares):
    return [{"kind": "random", "weight": share} for share in shares]


def test_equal_recipes_have_equal_digests_and_each_field_counts():
    assert recipe().digest == recipe(seed=0, transitions=50_000, coverage=None).digest
    others = [
        recipe(),
        recipe(seed=1),
        recipe(transitions=49_999),
        recipe(coverage=-0.2),
        recipe(spec={"complexity": 10}),
        recipe(behaviours=[{"kind": "mixture", "nu": 0.25}]),
        recipe(behaviours=weights(1.0)),
        recipe(protocol={"seed": 1}),
    ]
    assert len({other.digest for other in others}) == len(others)


def test_a_recipe_survives_its_json():
    parsed = recipe(behaviours=weights(0.5, 0.5), coverage=-0.25)
    assert DatasetRecipe.from_dict(parsed.to_dict()) == parsed


def test_differences_name_fields_with_both_values():
    assert recipe().differences(recipe()) == []
    asked = recipe(transitions=200, spec={"complexity": 10}, coverage=-0.2, protocol={"seed": 1})
    assert recipe().differences(asked) == [
        "spec.complexity 1, requested 10",
        "transitions 50000, requested 200",
        "coverage None, requested -0.2",
        "protocol.seed 0, requested 1",
    ]


def test_differences_of_behaviours_name_their_index_or_number():
    halves = recipe(behaviours=weights(0.5, 0.5))
    assert halves.differences(recipe(behaviours=weights(0.5, 0.25, 0.25))) == [
        "behaviours of 2 entries, requested 3"
    ]
    assert halves.differences(recipe(behaviours=weights(0.25, 0.75))) == [
        "behaviours.0.weight 0.5, requested 0.25",
        "behaviours.1.weight 0.5, requested 0.75",
    ]
    file = {"kind": "policy", "policy": "x", "sha256": "sha256:" + "0" * 64}
    named = recipe(behaviours=[{"kind": "policy", "policy": "x"}])
    (line,) = named.differences(recipe(behaviours=[file]))
    assert line.startswith("behaviours.0.sha256 None, requested 'sha256:000")


@pytest.mark.parametrize("nu", [-0.01, 1.01, float("nan"), float("inf"), "0.5", True])
def test_nu_outside_zero_to_one_is_refused(nu):
    with pytest.raises(SpecError, match=r"nu=.*must be .*\[0, 1\]"):
        recipe(behaviours=[{"kind": "mixture", "nu": nu}])


@pytest.mark.parametrize("shares", [(0.5, 0.4), (0.7, 0.4), (0.5, 0.5 + 2e-9), (0.999999,)])
def test_weights_that_do_not_add_up_are_refused(shares):
    with pytest.raises(SpecError, match="must add up to 1"):
        recipe(behaviours=weights(*shares))


def test_weights_may_differ_from_one_by_rounding():
    assert sum(recipe(behaviours=weights(*[0.1] * 10)).shares) == 50_000
    assert sum(recipe(behaviours=weights(0.5, 0.5 + 5e-10)).shares) == 50_000


@pytest.mark.parametrize("weight", [0.0, -0.5, 1.5, float("nan")])
def test_a_weight_outside_its_range_is_refused(weight):
    with pytest.raises(SpecError, match=r"weight=.*must be a finite number in \(0, 1\]"):
        parse_behaviour(0.5, weight)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("transitions", 0), ("transitions", 1.5), ("seed", -1), ("seed", 2**53), ("coverage", 0.1),
        ("coverage", -1.0), ("behaviours", []),
    ],
)  # fmt: skip
def test_other_fields_outside_their_range_are_refused(field, value):
    with pytest.raises(SpecError, match=f"{field}="):
        recipe(**{field: value})


@pytest.mark.parametrize(
    "fields",
    [
        {"kind": "mixture"},
        {"kind": "random", "nu": 0.5},
        {"kind": "policy"},
        {"kind": "random", "policy": "x"},
        {"kind": "mixture", "nu": 0.5, "sha256": "sha256:" + "0" * 64},
    ],
)
def test_fields_of_another_kind_of_behaviour_are_refused(fields):
    with pytest.raises(SpecError):
        Behaviour.from_dict(fields)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 1000, 50_000])
def test_shares_add_up_to_n_and_are_off_by_at_most_one(count):
    for shares in [(1.0,), (0.7, 0.3), (0.5, 0.25, 0.25), (1 / 3, 1 / 3, 1 / 3)]:
        if count * min(shares) < 0.9:
            continue
        parsed = recipe(behaviours=weights(*shares), transitions=count)
        assert sum(parsed.shares) == count
        assert np.abs(np.array(parsed.shares) - count * np.array(shares)).max() <= 1.0


def test_a_weight_of_less_than_one_transition_is_refused():
    with pytest.raises(SpecError, match="less than one of 10 transitions"):
        recipe(behaviours=weights(0.99, 0.01), transitions=10)


def test_behaviours_are_parsed_from_numbers_names_and_policies(tmp_path):
    assert parse_behaviour(0.5).nu == 0.5
    assert parse_behaviour(np.float32(0.5)).nu == 0.5
    assert parse_behaviour(0).label == "ν = 0"
    assert parse_behaviour("random").kind == "random"
    assert parse_behaviour(lambda observations: observations).label == "policy"
    path = tmp_path / "mine.zip"
    path.write_bytes(b"abc")
    parsed = parse_behaviour(path, action_range="symmetric")
    assert parsed.policy == "mine"
    assert (
        parsed.sha256 == "sha256:ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    )
    assert parsed.action_range == "symmetric"
    with pytest.raises(PolicyError, match="cannot be read"):
        parse_behaviour(tmp_path / "none.zip")
    for wrong in (None, True, [0.5]):
        with pytest.raises(SMEError, match="must be ν"):
            parse_behaviour(wrong)


def test_the_expected_similarity_is_one_minus_a_sixth_of_nu():
    assert recipe().expected_similarity == pytest.approx(1 - 0.5 / 6)
    mixed = [{"kind": "mixture", "nu": 0.3, "weight": 0.5}, {"kind": "random", "weight": 0.5}]
    assert recipe(behaviours=mixed).expected_similarity == pytest.approx(1 - 0.025 - 1 / 6)
    assert recipe(behaviours=[{"kind": "policy", "policy": "x"}]).expected_similarity is None
