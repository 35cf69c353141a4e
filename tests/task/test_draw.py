"""The drawn numbers: what METHOD asks of W, b and the layers, and which stream each comes from."""

import math

import numpy as np
import pytest
from hypothesis import given
from scipy import stats
from scipy.special import ndtri

from sme_registry.spec import SMESpec
from sme_registry.task import draw, materialize, streams
from tests.strategies import specs

GRID = 2.0**29


def layers_of(task):
    return [layer for policy in task.policies for layer in policy]


@given(specs())
def test_rows_of_the_transition_matrix_sum_to_exactly_one_on_the_grid(spec):
    W = materialize(spec).W
    assert W.shape == (spec.action_dim, spec.state_dim)
    assert (W >= 0).all()
    units = W * GRID
    np.testing.assert_array_equal(units, np.rint(units))
    for row in W:
        assert math.fsum(row) == 1.0


@pytest.mark.parametrize("state_dim", [1, 2, 1000, 2**20])
def test_rows_sum_to_one_at_every_width(state_dim):
    W = draw.transition_matrix(SMESpec(state_dim=state_dim, action_dim=2))
    assert [math.fsum(row) for row in W] == [1.0, 1.0]
    assert (W >= 0).all()
    np.testing.assert_array_equal(W * GRID, np.rint(W * GRID))


def test_the_transition_matrix_is_the_normalised_uniform_draw_to_the_grid():
    spec = SMESpec(state_dim=50, action_dim=20, seed=3)
    bits = streams.raw_bits(3, "transition/W", 1000).reshape(20, 50)
    uniform = bits.astype(np.float64) / 2.0**64
    expected = uniform / uniform.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(materialize(spec).W, expected, rtol=0, atol=1.01 / GRID)


def test_action_mass_is_conserved():
    task = materialize(SMESpec(state_dim=16, action_dim=16))
    a = np.random.default_rng(0).random((100, 16))
    np.testing.assert_allclose((a @ task.W).sum(axis=1), a.sum(axis=1), rtol=1e-12)


def test_uniform_numbers_are_uniform_and_never_zero_or_one():
    u = streams.uniform(0, "any", 100_000)
    assert stats.kstest(u, "uniform").pvalue > 0.01
    assert u.min() > 0.0
    assert u.max() < 1.0
    extremes = np.array([0, 2**64 - 1], np.uint64)
    assert streams.to_uniform(extremes)[0] > 0.0
    assert streams.to_uniform(extremes)[1] < 1.0


def test_normal_numbers_are_the_inverse_normal_of_the_uniform_ones():
    z = streams.gaussian(0, "any", 100_000)
    np.testing.assert_array_equal(z, ndtri(streams.uniform(0, "any", 100_000)))
    assert stats.kstest(z, "norm").pvalue > 0.01


def test_streams_of_other_names_and_seeds_are_other_numbers():
    names = ["transition/W", "transition/b", "policy/0/output", "policy/0/inner/0"]
    numbers = {
        streams.raw_bits(seed, name, 1)[0] for seed in (0, 1, "0x0", "0x1") for name in names
    }
    assert len(numbers) == 16


def test_a_longer_draw_from_a_stream_begins_as_the_shorter():
    np.testing.assert_array_equal(
        streams.raw_bits(5, "any", 1000)[:10], streams.raw_bits(5, "any", 10)
    )


@given(specs())
def test_layers_are_root_twelve_times_orthogonal_as_the_method_says(spec):
    for W, b in layers_of(materialize(spec)):
        outputs, inputs = W.shape
        np.testing.assert_allclose(b, -0.5 * W.sum(axis=1), rtol=0, atol=1e-14)
        if outputs <= inputs:  # narrowing and square: orthonormal rows under either init
            np.testing.assert_allclose(W @ W.T, 12.0 * np.eye(outputs), rtol=0, atol=1e-12)
        elif spec.policy_init == "semi_orthogonal":  # widening: orthonormal columns
            np.testing.assert_allclose(W.T @ W, 12.0 * np.eye(inputs), rtol=0, atol=1e-12)
        else:  # widening, rescaled: rows of norm √12
            np.testing.assert_allclose((W**2).sum(axis=1), 12.0, rtol=1e-12)


@given(specs(team=False))
def test_layers_run_from_the_state_over_inner_layers_to_the_action(spec):
    widths = [spec.state_dim, *[spec.hidden_width] * (spec.complexity - 1), spec.action_dim]
    layers = materialize(spec).layers
    assert [W.shape for W, _ in layers] == list(zip(widths[1:], widths[:-1], strict=True))
    assert [b.shape for _, b in layers] == [(width,) for width in widths[1:]]


def test_the_two_inits_agree_where_no_layer_widens():
    spec = SMESpec(state_dim=6, action_dim=3, complexity=3, hidden_width=6)
    ours, other = materialize(spec), materialize(spec.derive(policy_init="unit_variance"))
    for one, two in zip(ours.layers, other.layers, strict=True):
        np.testing.assert_array_equal(one.W, two.W)


def test_orthogonal_matrices_are_haar_distributed_in_sign():
    # QR alone gives Q a fixed sign pattern; with R's diagonal made positive the first entry of a
    # 2 × 2 Q is cos of a uniform angle, and its determinant ±1 equally often.
    matrices = np.array([draw._haar(seed, "haar", 2, 2) for seed in range(2000)])
    angles = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0]) / (2 * np.pi) + 0.5
    assert stats.kstest(angles, "uniform").pvalue > 0.01
    positive = int((np.linalg.det(matrices) > 0).sum())
    assert stats.binomtest(positive, 2000).pvalue > 0.01


def test_a_haar_matrix_reproduces_its_gaussian_with_a_positive_triangle():
    Q = draw._haar(7, "haar", 9, 4)
    R = Q.T @ streams.gaussian(7, "haar", 36).reshape(9, 4)
    assert (np.diag(R) > 0).all()
    np.testing.assert_allclose(np.tril(R, -1), 0.0, atol=1e-13)


# What a spec's field may change, and nothing else. Parts of a task: W, b, each layer by its stream.
BASE = {"state_dim": 6, "action_dim": 3, "complexity": 3, "hidden_width": 5, "seed": 11}
PARTS = {"W", "b", "inner/0", "inner/1", "output"}
FIELDS = [
    # field, other value, the parts that change
    ("k", 7, set()),
    ("r_min", 0.5, set()),
    ("D", 0.5, set()),
    ("horizon", 17, set()),
    ("rotation", 0.5, {"inner/0"}),
    ("complexity", 4, {"inner/2"}),
    ("complexity", 2, {"inner/1"}),
    ("hidden_width", 4, {"inner/0", "inner/1", "output"}),
    ("state_dim", 7, {"W", "b", "inner/0"}),
    ("action_dim", 2, {"W", "output"}),
    ("seed", 12, PARTS),
    ("seed", "0xb", PARTS),
    ("policy_init", "unit_variance", set()),
    ("team", {"agents": [{"action_dim": 3}], "reward": "team"}, set()),
    ("safety", {"tightness": 0.2}, {"safety"}),
    ("observation", {"distractors": 2}, set()),
    ("observation", {"distractors": 2, "dynamics": "driven"}, {"distractors"}),
    ("observation", {"mixing": "nonlinear", "mixing_depth": 2}, {"mixing/0", "mixing/1"}),
]


def parts(task):
    named = {f"inner/{i}": layer.W for i, layer in enumerate(task.policies[0][:-1])}
    if task.limiting:
        named["safety"] = task.limiting[-1].W
    if task.distractor_transition:
        named["distractors"] = task.distractor_transition[0]
    named |= {f"mixing/{i}": layer.W for i, layer in enumerate(task.mixing)}
    return {"W": task.W, "b": task.b, **named, "output": task.policies[0][-1].W}


@pytest.mark.parametrize(("field", "value", "changes"), FIELDS)
def test_a_field_changes_the_parts_it_should_and_no_others(field, value, changes):
    base = materialize(SMESpec.from_dict(BASE))
    other = materialize(SMESpec.from_dict(BASE | {field: value}))
    before, after = parts(base), parts(other)
    changed = {
        name for name in before.keys() | after.keys()
        if name not in before or name not in after or not np.array_equal(before[name], after[name])
    }  # fmt: skip
    assert changed == changes
    assert base.spec.digest != other.spec.digest


def test_the_table_of_changes_covers_every_field():
    assert {field for field, _, _ in FIELDS} == SMESpec.model_fields.keys() - {"schema_version"}


def test_the_init_changes_only_layers_that_widen():
    spec = SMESpec.from_dict(BASE | {"hidden_width": 9})
    one, two = materialize(spec), materialize(spec.derive(policy_init="unit_variance"))
    same = {name: np.array_equal(parts(one)[name], parts(two)[name]) for name in parts(one)}
    assert same == {"W": True, "b": True, "inner/0": False, "inner/1": True, "output": True}


def test_more_action_channels_leave_the_rows_of_those_that_were_there():
    few, more = (materialize(SMESpec(action_dim=n, seed=4)) for n in (3, 5))
    np.testing.assert_array_equal(few.W, more.W[:3])
    np.testing.assert_array_equal(few.b, more.b)


def test_more_state_channels_leave_the_offsets_of_those_that_were_there():
    few, more = (materialize(SMESpec(state_dim=n, seed=4)) for n in (3, 5))
    np.testing.assert_array_equal(few.b, more.b[:3])


def test_one_more_agent_leaves_the_policies_of_those_that_were_there():
    agents = [{"action_dim": 2}, {"action_dim": 1, "observes": [0, 2]}]
    two = materialize(SMESpec(action_dim=3, complexity=2, team={"agents": agents}))
    more = [*agents, {"action_dim": 4}]
    three = materialize(SMESpec(action_dim=7, complexity=2, team={"agents": more}))
    for one, other in zip(two.policies, three.policies[:2], strict=True):
        for layer, same in zip(one, other, strict=True):
            np.testing.assert_array_equal(layer.W, same.W)
    np.testing.assert_array_equal(two.W, three.W[:3])


def test_what_an_agent_observes_moves_its_own_first_layer_and_nothing_else():
    def drawn(observes):
        agents = [{"action_dim": 2, "observes": observes}, {"action_dim": 2}]
        return materialize(SMESpec(complexity=2, team={"agents": agents}))

    one, other = drawn([0, 1]), drawn([0, 1, 5])
    assert one.policies[0][0].W.shape != other.policies[0][0].W.shape
    np.testing.assert_array_equal(one.policies[0][1].W, other.policies[0][1].W)
    np.testing.assert_array_equal(one.policies[1][0].W, other.policies[1][0].W)
    np.testing.assert_array_equal(one.W, other.W)


def test_a_single_agent_is_a_team_of_one():
    alone = materialize(SMESpec(complexity=2))
    team = materialize(SMESpec(complexity=2, team={"agents": [{"action_dim": 4}]}))
    s = np.random.default_rng(0).random((10, 8))
    np.testing.assert_array_equal(alone.optimal_action(s), team.optimal_action(s))
    assert [layer.W.shape for layer in alone.layers] == [W.shape for W, _ in team.layers[0]]


def test_the_same_spec_is_the_same_task_bit_for_bit():
    spec = SMESpec(complexity=3, seed="0xabc")
    from sme_registry.task.loading import _draw

    one, other = _draw(spec), _draw(spec)
    for mine, its in zip(layers_of(one), layers_of(other), strict=True):
        np.testing.assert_array_equal(mine.W, its.W)
        np.testing.assert_array_equal(mine.b, its.b)
    np.testing.assert_array_equal(one.W, other.W)
    np.testing.assert_array_equal(one.b, other.b)


def test_a_tasks_arrays_cannot_be_written_to():
    task = materialize(SMESpec(complexity=2))
    for array in (task.W, task.b, *(part for layer in task.layers for part in layer)):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


def test_counted_words_are_those_of_splitmix64():
    # Published for the seed 1234567: https://rosettacode.org/wiki/Pseudo-random_numbers/Splitmix64
    published = [
        6457827717110365317, 3203168211198807973, 9817491932198370423,
        4593380528125082431, 16408922859458223821,
    ]  # fmt: skip
    with np.errstate(over="ignore"):
        places = np.uint64(1234567) + streams.GOLDEN * np.arange(1, 6, dtype=np.uint64)
    assert streams.mixed_bits(places).tolist() == published


def test_counted_numbers_do_not_depend_on_what_is_drawn_with_them():
    keys, first = np.array([5, 2**52 - 1, 0], np.uint64), np.array([1, 900, 7], np.uint64)
    together = streams.counted(keys, first, 40)
    assert ((together > 0) & (together < 1)).all()
    for row, key, place in zip(together, keys, first, strict=True):
        for i in (0, 17, 39):
            alone = streams.counted(key[None], (place + np.uint64(i))[None], 1)
            assert alone.item() == row[i]


def test_counted_numbers_are_uniform_within_and_between_streams():
    keys = np.arange(2000, dtype=np.uint64)
    u = streams.counted(keys, np.ones(2000, np.uint64), 50)
    for axis in (0, 1):
        error = 5 / np.sqrt(12 * u.shape[axis])
        assert np.abs(u.mean(axis=axis) - 0.5).max() < error
    for one, other in ((u[:-1], u[1:]), (u[:, :-1], u[:, 1:])):
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.016
