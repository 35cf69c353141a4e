"""The twin: rounding errors that reach the actions are found, and honest policies pass."""

from __future__ import annotations

import numpy as np
import pytest
from onnx import TensorProto

from leaderboard.artefact import twin
from leaderboard.artefact.gate import inspect, widths
from leaderboard.artefact.reference import optimal_onnx
from leaderboard.artefact.sandbox import MAX_ROUNDING, Sandbox
from leaderboard.errors import Rejection
from sme_registry import SMESpec
from sme_registry.export import operators
from tests.leaderboard.artefact.models import (
    ACTION,
    OBSERVATION,
    model,
    network,
    node,
    tensor,
    weights,
)

ROWS = 500
f32 = np.float32
RNG = np.random.default_rng(0)


def rounding(found, dims=(OBSERVATION, ACTION), isolation="process"):
    """Mean |Δ action| of a model, or of its bytes."""
    data = found if isinstance(found, bytes) else found.SerializeToString()
    observations = np.random.default_rng(1).random((ROWS, dims[0]), f32)
    with Sandbox(data, *dims, isolation=isolation) as policy:
        change = policy.rounding(observations)
    assert change.shape == (ROWS,)
    assert change.dtype == np.float64
    return change.mean()


def policy(*nodes, opset=17, **tensors):
    """A model from `o` to `a`; every tensor in single precision, if not given as an array."""
    found = [
        tensor(name, each if isinstance(each, np.ndarray) else f32(each))
        for name, each in tensors.items()
    ]
    return model(list(nodes), [*found, weights()], opsets=[("", opset)])


def amplified(*nodes, factor, **tensors):
    """½ + factor · `d`, where the nodes compute `d` from `y` = o W."""
    return policy(
        node("MatMul", "o W", "y"),
        *nodes,
        node("Mul", "d factor", "amplified"),
        node("Add", "amplified half", "a"),
        factor=factor,
        half=0.5,
        opset=20,
        **tensors,
    )


def last_bits(operator):
    """The last bits of a function of the observation."""
    return policy(
        node("MatMul", "o W", "y"),
        node("Abs", "y", "x"),
        node("Add", "x one", "z"),
        node(operator, "z", "f"),
        node("Mul", "f scale", "g"),
        node("Floor", "g", "h"),
        node("Sub", "g h", "a"),
        one=1.0,
        scale=2.0**21,
        opset=20,
    )


def repeated(weights_of_copies):
    """A sum of copies of one channel whose exact value is 0."""
    columns = np.repeat(RNG.permutation(weights_of_copies)[:, None], ACTION, axis=1)
    return np.zeros(len(columns), np.int64), columns


def tail(operator, at, factor):
    """The tail of a function, where a kernel may round to 0."""
    return amplified(
        node("Abs", "y", "x"),
        node("Sub", "at x", "z"),
        node(operator, "z", "d"),
        at=at,
        factor=factor,
    )


def first_channel(*nodes, **tensors):
    """A function of the first channel alone, `x`, into both actions by `z ones`."""
    return policy(
        node("Gather", "o zero", "x", axis=1),
        *nodes,
        node("MatMul", "z ones", "a"),
        zero=np.int64([0]),
        ones=np.ones((1, ACTION), f32),
        **tensors,
    )


def rare():
    """x² − x·x, amplified, only in a hundredth of the states."""
    return policy(
        node("MatMul", "o W", "y"),
        node("Pow", "y two", "p"),
        node("Mul", "y y", "m"),
        node("Sub", "p m", "d"),
        node("Mul", "d factor", "z"),
        node("Gather", "o zero", "x", axis=1),
        node("Greater", "x edge", "there"),
        node("Where", "there z half", "a"),
        two=2.0,
        factor=1e10,
        half=0.5,
        edge=0.99,
        zero=np.int64([0]),
    )


COPIES, CANCELLING = repeated([0.1] * 30 + [-0.1] * 30)

SENSITIVE = {
    "x² − x·x": amplified(
        node("Pow", "y two", "p"), node("Mul", "y y", "m"), node("Sub", "p m", "d"),
        two=2.0, factor=1e10,
    ),
    "two identical columns of a product": amplified(
        node("MatMul", "o WW", "u"), node("Split", "u", "v w", axis=1, num_outputs=2),
        node("Sub", "v w", "d"), factor=1e8,
        WW=np.repeat(RNG.normal(size=(OBSERVATION, 1)).astype(f32), 2 * ACTION, axis=1),
    ),
    "copies that cancel in double precision": amplified(
        node("Gather", "o copies", "c", axis=1), node("Cast", "c", "x", to=TensorProto.DOUBLE),
        node("MatMul", "x V", "e"), node("Mul", "e large", "l"),
        node("Cast", "l", "d", to=TensorProto.FLOAT),
        copies=COPIES, V=CANCELLING, large=np.array(1e16), factor=1.0,
    ),
    "a sum of constants": amplified(
        node("MatMul", "K V", "e"), node("Mul", "y zero", "n"), node("Add", "n e", "d"),
        K=np.ones((1, len(CANCELLING)), f32), V=CANCELLING.astype(f32), zero=0.0, factor=1e7,
    ),
    "1 − erf": amplified(
        node("Abs", "y", "x"), node("Add", "x far", "z2"), node("Erf", "z2", "e"),
        node("Sub", "one e", "d"), far=3.8, one=1.0, factor=1e7,
    ),
    "the tail of a sigmoid": tail("Sigmoid", -17.0, 1e7),
    "a hundredth of the states": rare(),
    "the last bits of the observation, by operators that do not round": first_channel(
        node("Mod", "x unit", "m", fmod=1), node("Mul", "m scale", "z"),
        unit=2.0**-20, scale=2.0**20,
    ),
    "a hash of the observation in integers": first_channel(
        node("Mul", "x scale", "g"), node("Cast", "g", "i", to=TensorProto.INT64),
        node("Mod", "i prime", "r"), node("Cast", "r", "q", to=TensorProto.FLOAT),
        node("Mul", "q small", "z"),
        scale=2.0**24, prime=np.array(97), small=1 / 97,
    ),
    "a sum of integers that are too large to be exact": amplified(
        node("Sign", "y", "s"), node("Mul", "s most", "m"), node("Add", "m one", "p"),
        node("Sub", "p m", "d"), most=2.0**24, one=1.0, factor=0.1,
    ),
    "a cast to integers that overflows": amplified(
        node("Mul", "y huge", "h"), node("Cast", "h", "i", to=TensorProto.INT32),
        node("Cast", "i", "d", to=TensorProto.FLOAT), huge=1e12, factor=2.0**-31,
    ),
    **{f"the last bits of {name}": last_bits(name)
       for name in ("Exp", "Tanh", "Sqrt")},
}  # fmt: skip


@pytest.mark.parametrize("kind", SENSITIVE)
def test_a_policy_that_amplifies_rounding_errors_is_refused(kind):
    data = SENSITIVE[kind].SerializeToString()
    inspect(data, OBSERVATION, ACTION)
    rows = 10 * ROWS  # a hundredth of them are enough for one that is not rounded to ½
    observations = np.random.default_rng(1).random((rows, OBSERVATION), f32)
    opened = Sandbox(data, OBSERVATION, ACTION, isolation="process")
    with opened, pytest.raises(Rejection, match="run_rounding"):
        opened.check_rounding(observations)


def tree_of_products():
    """A tree as products: which conditions hold, how many of each leaf, and so which leaf."""
    leaves = np.arange(8)
    signs, satisfied = np.zeros((7, 8), f32), np.zeros(8, f32)
    for leaf in leaves:
        at = 0
        for level in (2, 1, 0):
            right = leaf >> level & 1
            signs[at, leaf] = -1.0 if right else 1.0
            satisfied[leaf] += not right
            at = 2 * at + 1 + right
    return policy(
        node("MatMul", "o A", "x"),
        node("Less", "x B", "c"),
        node("Cast", "c", "t", to=TensorProto.FLOAT),
        node("MatMul", "t C", "s"),
        node("Equal", "s D", "e"),
        node("Cast", "e", "l", to=TensorProto.FLOAT),
        node("MatMul", "l E", "a"),
        A=np.eye(OBSERVATION, dtype=f32)[RNG.integers(OBSERVATION, size=7)].T.copy(),
        B=RNG.random(7).astype(f32),
        C=signs,
        D=satisfied,
        E=RNG.random((8, ACTION)).astype(f32),
    )


def table():
    """A table of 10⁴ cells; the cell's index is a sum of floating-point integers."""
    return policy(
        node("Mul", "o ten", "g"),
        node("Floor", "g", "h"),
        node("Clip", "h low high", "c"),
        node("MatMul", "c strides", "j"),
        node("Cast", "j", "i", to=TensorProto.INT64),
        node("Squeeze", "i last", "k"),
        node("Gather", "table k", "a", axis=0),
        ten=10.0,
        low=0.0,
        high=9.0,
        strides=f32([[1000], [100], [10], [1]]),
        last=np.int64([1]),
        table=RNG.random((10_000, ACTION)).astype(f32),
    )


INSENSITIVE = {
    "a network": (network(64), 1e-6),
    "a tree of products": (tree_of_products(), 1e-6),
    "a table": (table(), 0.0),
    "one of two actions": (
        amplified(node("Sign", "y", "d"), factor=0.5), 1e-6
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", INSENSITIVE)
def test_an_honest_policy_changes_far_less_than_the_limit(kind):
    found, most = INSENSITIVE[kind]
    assert rounding(found) <= most
    assert most < MAX_ROUNDING / 3.0


def test_the_optimal_policy_of_a_team_changes_far_less_than_the_limit():
    team = {"agents": [{"action_dim": 1}, {"action_dim": 1}]}
    spec = SMESpec(state_dim=3, action_dim=2, complexity=20, team=team)
    assert rounding(optimal_onnx(spec), widths(spec)) <= 1e-6


def test_errors_are_drawn_anew_in_each_run_and_reach_every_row():
    observations = np.random.default_rng(1).random((ROWS, OBSERVATION), f32)
    found = policy(node("MatMul", "o W", "y"), node("Sigmoid", "y", "a"))
    with Sandbox(found.SerializeToString(), OBSERVATION, ACTION) as opened:
        first, second = opened.rounding(observations), opened.rounding(observations)
        assert (opened(observations) == opened(observations)).all()
    assert (first != second).mean() > 0.7
    assert (first > 0.0).mean() > 0.7


@pytest.mark.parametrize("opset", [13, 23])
def test_every_opset_has_a_twin(opset):
    found = network(8)
    found.opset_import[0].version = opset
    assert 0.0 < rounding(found, isolation=None) < 1e-5


def test_an_action_that_becomes_no_number_counts_as_changed():
    # 0 · (1 ± δ) is 0 and its reciprocal infinite, but x − x is 0 only without errors.
    found = policy(
        node("MatMul", "o W", "y"),
        node("Mul", "y y", "s"),
        node("Pow", "y two", "t"),
        node("Sub", "s t", "d"),
        node("Abs", "d", "e"),
        node("Sub", "e tiny", "f"),
        node("Neg", "f", "g"),
        node("Sqrt", "g", "h"),
        node("Mul", "h zero", "a"),
        two=2.0,
        tiny=1e-12,
        zero=0.0,
    )
    assert rounding(found) > 0.5


def test_nodes_may_stand_in_any_order():
    found = network(8)
    nodes = list(found.graph.node)
    del found.graph.node[:]
    found.graph.node.extend(reversed(nodes))
    inspect(found.SerializeToString(), OBSERVATION, ACTION)
    assert twin.rounding_twin(found.SerializeToString())


def test_every_operator_that_boards_accept_has_a_rule():
    listed = twin.EXACT | twin.SUMS | twin.FLOORS.keys()
    assert listed <= operators.FEED_FORWARD
    assert twin.EXACT.isdisjoint(twin.SUMS | twin.FLOORS.keys())
    arithmetic = "Add Cosh Div LeakyRelu Mul PRelu Reciprocal Sqrt Sub"
    assert operators.FEED_FORWARD - listed == set(arithmetic.split())  # errors of their size only
