"""`Integers`: values that are integers so small that floating-point arithmetic on them is exact.

Trees count the conditions that hold, and tables compute an index, by sums of small integers in
float32. Such sums are the same in every order, so they have no rounding errors to draw:

    |x| ≤ m, integer    m is known for constants, for bool → float, for sign and for clipped floor
    x + y               m_x + m_y
    x y, x W            m_x m_y, m_x Σ|W|           W constant

They are exact as long as m ≤ 2²⁴ in float32 and 2⁵³ in float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from leaderboard.artefact import schema
from leaderboard.artefact.graph import BOOL, DOUBLE, FLOAT, Node, numbers, read, text

_EXACT_UP_TO = {FLOAT: 2.0**24, DOUBLE: 2.0**53}

_SAME = """
    Abs Cast Flatten Gather GatherElements Identity Neg ReduceMax ReduceMin Relu Reshape Slice Split
    Squeeze Transpose Unsqueeze
"""
# From the bounds of a node's inputs to that of its outputs; not a number where it is no integer.
_BOUNDS: dict[str, Callable[[list[float]], float]] = {
    **dict.fromkeys(_SAME.split(), lambda m: m[0]),
    **dict.fromkeys(("Ceil", "Floor", "Round"), lambda _: math.inf),
    **dict.fromkeys(("Concat", "Max", "Min"), lambda m: float(np.max(m))),
    **dict.fromkeys(("Add", "Sub", "Sum"), sum),
    "Sign": lambda _: 1.0,
    "Mul": math.prod,
    "Where": lambda m: float(np.max(m[1:])),
    "Clip": lambda m: float(np.max(m[1:])) if len(m) == 3 and m[0] >= 0.0 else math.nan,
}


class Integers:
    """The bounds m of a graph's values; nodes are added in order.

    Args:
      tensors: the graph's constants.
    """

    def __init__(self, tensors: Iterable[dict[str, list[Any]]]) -> None:
        self._bounds: dict[str, float] = {}
        self._sums: dict[str, float] = {}  # Σ|W| of constants
        for tensor in tensors:
            self._add_constant(text(tensor["name"][0]), tensor)

    def add(self, node: Node, input_types: list[int], type: int) -> bool:
        """Add a node with outputs of this type; return whether it computes integers exactly."""
        if node.operator == "Constant" and "value" in node.attributes:
            tensor = read(node.attributes["value"]["t"][0], schema.TENSOR)
            self._add_constant(node.outputs[0], tensor)
        if type not in _EXACT_UP_TO:
            return False
        bound = self._bound(node, input_types)
        if not math.isnan(bound):
            self._bounds |= dict.fromkeys(node.outputs, bound)
        return bound <= _EXACT_UP_TO[type]

    def _bound(self, node: Node, input_types: list[int]) -> float:
        bounds = [self._bounds.get(name, math.nan) for name in node.inputs]
        if node.operator == "Cast" and input_types[0] == BOOL:
            return 1.0
        if node.operator in ("MatMul", "Gemm"):
            return self._product(node, bounds)
        return _BOUNDS[node.operator](bounds) if node.operator in _BOUNDS else math.nan

    def _product(self, node: Node, bounds: list[float]) -> float:
        """m_x Σ|W| + m_c; one factor is a constant, and a Gemm has no other factors."""
        if not {"alpha", "beta"}.isdisjoint(node.attributes):
            return math.nan
        left, right = node.inputs[:2]
        if right in self._sums:
            product = bounds[0] * self._sums[right]
        else:
            product = bounds[1] * self._sums.get(left, math.nan)
        return product + sum(bounds[2:])

    def _add_constant(self, name: str, tensor: dict[str, list[Any]]) -> None:
        values = numbers(tensor)
        if values is not None and np.isfinite(values).all() and (values == np.rint(values)).all():
            self._bounds[name] = float(np.abs(values).max(initial=0.0))
            self._sums[name] = float(np.abs(values).sum(dtype=np.float64))
