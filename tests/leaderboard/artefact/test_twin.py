"""The twin: rounding errors that reach the actions are found, and honest policies pass."""

import numpy as np
import pytest
from onnx import TensorProto

from leaderboard.artefact import twin
from leaderboard.artefact.gate import inspect
from leaderboard.artefact.sandbox import MAX_ROUNDING, Sandbox
from leaderboard.errors import Rejection
from sme_registry.export import FEED_FORWARD
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


def rounding(found):
    """Mean |Δ action| of a model."""
    data = found.SerializeToString()
    observations = np.random.default_rng(1).random((ROWS, OBSERVATION), f32)
    with Sandbox(data, OBSERVATION, ACTION, isolation="process") as policy:
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
    "the tail of a sigmoid": amplified(
        node("Abs", "y", "x"), node("Sub", "at x", "z"), node("Sigmoid", "z", "d"),
        at=-17.0, factor=1e7,
    ),
    "a sum of integers that are too large to be exact": amplified(
        node("Sign", "y", "s"), node("Mul", "s most", "m"), node("Add", "m one", "p"),
        node("Sub", "p m", "d"), most=2.0**24, one=1.0, factor=0.1,
    ),
    "a cast to integers that overflows": amplified(
        node("Mul", "y huge", "h"), node("Cast", "h", "i", to=TensorProto.INT32),
        node("Cast", "i", "d", to=TensorProto.FLOAT), huge=1e12, factor=2.0**-31,
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", SENSITIVE)
def test_a_policy_that_amplifies_rounding_errors_is_refused(kind):
    data = SENSITIVE[kind].SerializeToString()
    inspect(data, OBSERVATION, ACTION)
    observations = np.random.default_rng(1).random((ROWS, OBSERVATION), f32)
    opened = Sandbox(data, OBSERVATION, ACTION, isolation="process")
    with opened, pytest.raises(Rejection, match="run_rounding"):
        opened.check_rounding(observations)


def test_an_honest_policy_changes_far_less_than_the_limit():
    for opset in (13, 23):
        found = network(64)
        found.opset_import[0].version = opset
        assert 0.0 < rounding(found) <= 1e-6 < MAX_ROUNDING / 3.0


def test_errors_are_drawn_anew_in_each_run_and_reach_every_row():
    observations = np.random.default_rng(1).random((ROWS, OBSERVATION), f32)
    found = policy(node("MatMul", "o W", "y"), node("Sigmoid", "y", "a"))
    with Sandbox(found.SerializeToString(), OBSERVATION, ACTION) as opened:
        first, second = opened.rounding(observations), opened.rounding(observations)
        assert (opened(observations) == opened(observations)).all()
    assert (first != second).mean() > 0.7
    assert (first > 0.0).mean() > 0.7


def test_nodes_may_stand_in_any_order():
    found = network(8)
    nodes = list(found.graph.node)
    del found.graph.node[:]
    found.graph.node.extend(reversed(nodes))
    inspect(found.SerializeToString(), OBSERVATION, ACTION)
    assert twin.rounding_twin(found.SerializeToString())


def test_every_operator_that_boards_accept_has_a_rule():
    listed = twin.EXACT | twin.SUMS | twin.FLOORS.keys()
    assert listed <= FEED_FORWARD
    assert twin.EXACT.isdisjoint(twin.SUMS | twin.FLOORS.keys())
    arithmetic = "Add Cosh Div LeakyRelu Mul PRelu Reciprocal Sqrt Sub"
    assert FEED_FORWARD - listed == set(arithmetic.split())  # errors of their size only
