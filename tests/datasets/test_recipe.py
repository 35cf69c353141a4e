"""The recipe of a data set: its digest and its validation."""

import numpy as np
import pytest

from sme_registry.datasets import DatasetRecipe
from sme_registry.datasets.documents import parse_behaviour
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


def test_weights_may_differ_from_one_by_rounding():
    assert sum(recipe(behaviours=weights(*[0.1] * 10)).shares) == 50_000
    assert sum(recipe(behaviours=weights(0.5, 0.5 + 5e-10)).shares) == 50_000


def mixture(nu):
    return [{"kind": "mixture", "nu": nu}]


FILE = "sha256:" + "0" * 64


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        *(({"behaviours": mixture(nu)}, r"nu=.*must be .*\[0, 1\]")
          for nu in (-0.01, 1.01, float("nan"), float("inf"), "0.5", True)),
        *(({"behaviours": weights(*shares)}, "must add up to 1")
          for shares in ((0.5, 0.4), (0.7, 0.4), (0.5, 0.5 + 2e-9), (0.999999,))),
        *(({"behaviours": weights(share)}, r"weight=.*must be .*in \(0, 1\]")
          for share in (0.0, -0.5, 1.5, float("nan"))),
        *(({"behaviours": [{"kind": kind, **own}]}, "behaviours")
          for kind, own in [("mixture", {}), ("random", {"nu": 0.5}), ("policy", {}),
                            ("random", {"policy": "x"}), ("mixture", {"nu": 0.5, "sha256": FILE})]),
        ({"behaviours": weights(0.99, 0.01), "transitions": 10},
         "less than one of 10 transitions"),
        ({"transitions": 0}, "transitions="), ({"transitions": 1.5}, "transitions="),
        ({"seed": -1}, "seed="), ({"seed": 2**53}, "seed="), ({"coverage": 0.1}, "coverage="),
        ({"coverage": -1.0}, "coverage="), ({"behaviours": []}, "behaviours="),
    ],
)  # fmt: skip
def test_invalid_fields_are_refused_by_name(fields, message):
    with pytest.raises(SpecError, match=message):
        recipe(**fields)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 1000, 50_000])
def test_shares_add_up_to_n_and_are_off_by_at_most_one(count):
    for shares in [(1.0,), (0.7, 0.3), (0.5, 0.25, 0.25), (1 / 3, 1 / 3, 1 / 3)]:
        if count * min(shares) < 0.9:
            continue
        parsed = recipe(behaviours=weights(*shares), transitions=count)
        assert sum(parsed.shares) == count
        assert np.abs(np.array(parsed.shares) - count * np.array(shares)).max() <= 1.0


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
