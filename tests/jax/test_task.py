"""Drawn tasks as pytrees: lanes, padding, and specs that are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sme_registry import SMESpec, materialize
from sme_registry.errors import OptionError, SpecError
from sme_registry.jax.task import SUPPORTED_FIELDS, Shape, check_supported, task_params


def test_one_task_has_the_numbers_of_its_draw():
    task = materialize(SMESpec(complexity=4, hidden_width=5, k=3, r_min=0.25, D=0.5, horizon=7))
    params = task_params(task.spec)
    assert (params.k, params.r_min, params.D, params.horizon) == (3, 0.25, 0.5, 7)
    assert (params.state_dim, params.action_dim) == (8, 4)
    assert params.inner is not None
    stacked = params.inner.stacked
    layers = [params.inner.first, *zip(stacked.W, stacked.b, strict=True), params.output]
    for computed, drawn in zip(
        [(params.W, params.b), *layers], [(task.W, task.b), *task.layers], strict=True
    ):
        assert (np.asarray(computed[0]) == drawn[0]).all()
        assert (np.asarray(computed[1]) == drawn[1]).all()


def test_lanes_are_padded_to_the_smallest_shape_that_covers_them():
    specs = [
        SMESpec(state_dim=3, action_dim=5, complexity=2, hidden_width=4),
        SMESpec(state_dim=6, action_dim=2, complexity=4, hidden_width=3),
    ]
    params = task_params(specs)
    assert params.W.shape == (2, 5, 6)
    assert params.inner is not None
    assert params.inner.stacked.W.shape == (2, 2, 4, 4)
    assert params.inner.active.tolist() == [[False, False], [True, True]]
    assert params.output.W.shape == (2, 5, 4)
    first = jax.tree.map(lambda part: part[0], params)
    assert first.action_mask.tolist() == [True] * 5
    assert first.state_mask.tolist() == [True] * 3 + [False] * 3
    assert (first.W[:, 3:] == 0).all()
    assert (first.b[3:] == 0).all()


def test_dtypes_are_those_of_the_oracle_and_of_states():
    params = task_params(SMESpec(), dtype=jnp.float32)
    assert params.output.W.dtype == params.D.dtype == jnp.float32
    assert params.W.dtype == jnp.float64
    assert task_params(SMESpec(), states="pairs").W.dtype == jnp.uint32


def test_a_list_of_names_or_fields_has_an_axis_of_lanes_and_any_shape_that_covers_it():
    assert task_params(["SME/Default-v1", {"seed": 0}]).W.shape == (2, 4, 8)
    assert task_params([SMESpec()]).W.shape == (1, 4, 8)
    assert task_params(SMESpec()).W.shape == (4, 8)
    assert task_params(SMESpec(state_dim=3), shape=(5, 6, 1, 9)).output.W.shape == (6, 5)


TEAM = SMESpec.from_dict({"action_dim": 2, "team": {"agents": [{"action_dim": 1}] * 2}})


@pytest.mark.parametrize(
    ("specs", "options", "message"),
    [
        ([SMESpec(), SMESpec(complexity=2)], {}, r"complexity=1 .* 2: must be 1 for all"),
        (SMESpec(), {"shape": Shape(8, 3, 1, 0)}, r"shape.action_dim=3: must be at least 4"),
        (SMESpec(), {"shape": (8, 4, 1, "wide")}, r"^shape=.*: must be a Shape of state_dim"),
        ([], {}, r"specs=\[\]: must have at least one"),
        (SMESpec(), {"states": "int"}, r"states='int': must be 'float64' or 'pairs'"),
        (SMESpec(), {"dtype": jnp.bfloat16}, r"dtype=.*: must be float64 or float32"),
        (TEAM, {}, r"^team=.*must be absent, since tasks in JAX have no team"),
    ],
)
def test_what_is_no_task_in_jax_is_refused_by_name(specs, options, message):
    with pytest.raises(SpecError if specs is TEAM else OptionError, match=message):
        task_params(specs, **options)


class FutureSpec(SMESpec):
    """A spec with a field of a later version."""

    gravity: float = 0.0


def test_every_field_is_supported_or_refused_on_purpose_and_later_ones_have_their_default():
    assert SMESpec.model_fields.keys() - SUPPORTED_FIELDS == {"team"}
    assert SMESpec.model_fields.keys() >= SUPPORTED_FIELDS
    check_supported(FutureSpec())
    with pytest.raises(SpecError, match=r"^gravity=0.3: must be absent"):
        check_supported(FutureSpec(gravity=0.3))
