"""Shape arithmetic of a traced network, replaced by the numbers that it computes.

PyTorch writes `x.chunk(2, -1)` and `x.view(x.shape[0], -1)` with `Shape`, and computes sizes from
it, although only the batch size varies. Values that depend on no entry of the observations are
computed for two batch sizes; those that are equal become constants.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from sme_registry.evaluation.models import start_session
from sme_registry.export.network import INPUT

_BATCHES = 2, 3
_SIZES = "Shape", "Size"  # of their input they read the shape alone


def fold_shapes(model: Any, observation_dim: int, *, broadcast: bool) -> None:
    """Replace what is computed from shapes alone, in place."""
    import onnx

    nodes = list(model.graph.node)
    computed = set(_computed_from_shapes(model))
    consumed = {
        name
        for node in nodes
        if not computed.issuperset(node.output)
        for name in read_by(node)
        if name in computed
    }
    consumed -= {name for node in nodes if node.op_type == "Constant" for name in node.output}
    if not consumed:
        return
    reshapes = [node for node in nodes if node.op_type == "Reshape" and node.input[1] in consumed]
    reshaped = {node.output[0] for node in reshapes}
    values = _values(model, observation_dim, consumed | reshaped)
    folded = {
        name: _constant(*(each[name] for each in values), broadcast=broadcast) for name in consumed
    }
    for node in reshapes:
        # Sizes of its own: another reader of these may need the batch size itself.
        sizes = _sizes(*(each[node.output[0]].shape for each in values))
        if folded[node.input[1]] is None and sizes is not None:
            node.input[1] = f"{node.output[0]}.sizes"
            folded[node.input[1]] = sizes
    constants = {name: value for name, value in folded.items() if value is not None}
    del model.graph.node[:]
    for name, value in sorted(constants.items()):
        tensor = onnx.numpy_helper.from_array(np.ascontiguousarray(value), name)
        model.graph.node.append(onnx.helper.make_node("Constant", [], [name], value=tensor))
    model.graph.node.extend(node for node in nodes if constants.keys().isdisjoint(node.output))


def read_by(node: Any) -> Iterator[str]:
    """The values that a node reads, those in its branches and loops included."""
    yield from node.input
    for graph in _subgraphs(node):
        yield from (output.name for output in graph.output)
        for inner in graph.node:
            yield from read_by(inner)


def _subgraphs(node: Any) -> Iterator[Any]:
    for attribute in node.attribute:
        if attribute.HasField("g"):
            yield attribute.g
        yield from attribute.graphs


def _computed_from_shapes(model: Any) -> Iterable[str]:
    """The outputs of nodes that depend on no entry of the observations, only on their shape."""
    dependent = {INPUT}
    for node in model.graph.node:
        outputs = [name for name in node.output if name]
        reads = () if node.op_type in _SIZES else read_by(node)
        # One output each: the constant that replaces it is a node of its own.
        if len(outputs) != 1 or any(_subgraphs(node)) or dependent.intersection(reads):
            dependent.update(outputs)
        else:
            yield outputs[0]


def _values(model: Any, observation_dim: int, names: Iterable[str]) -> list[dict[str, Any]]:
    """The values of these names for each of the batch sizes."""
    import onnx

    names = sorted(names)
    probe = onnx.ModelProto()
    probe.CopyFrom(model)
    del probe.graph.output[:]
    probe.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names)
    session = start_session(probe.SerializeToString())
    random = np.random.default_rng(0)
    batches = [random.random((rows, observation_dim), dtype=np.float32) for rows in _BATCHES]
    return [dict(zip(names, session.run(names, {INPUT: x}), strict=True)) for x in batches]


def _constant(few: Any, many: Any, *, broadcast: bool) -> Any:
    """The value for any batch size; None if there is no such value."""
    if few.shape == many.shape:
        return few if np.array_equal(few, many) else None
    axis = _batch_axis(few.shape, many.shape)
    if axis is None or not broadcast:
        return None
    one = few.take([0], axis)
    return one if (few == one).all() and (many == one).all() else None


def _sizes(few: tuple[int, ...], many: tuple[int, ...]) -> Any:
    """The sizes to reshape to, −1 for that of the batch."""
    axis = _batch_axis(few, many)
    if few != many and axis is None:
        return None
    return np.array([-1 if i == axis else size for i, size in enumerate(few)], dtype=np.int64)


def _batch_axis(few: tuple[int, ...], many: tuple[int, ...]) -> int | None:
    """The one axis whose length differs."""
    if len(few) != len(many):
        return None
    axes = [axis for axis, sizes in enumerate(zip(few, many, strict=True)) if len({*sizes}) > 1]
    return axes[0] if len(axes) == 1 else None
