"""Small ONNX models, good and bad, made with the `onnx` package."""

import itertools

import numpy as np
from onnx import TensorProto, helper, numpy_helper

FLOAT = TensorProto.FLOAT
OBSERVATION, ACTION = 4, 2


def node(operator, inputs, outputs, **attributes):
    return helper.make_node(operator, inputs.split(), outputs.split(), **attributes)


def value(name, *shape, type=FLOAT):
    return helper.make_tensor_value_info(name, type, shape)


def tensor(name, array):
    return numpy_helper.from_array(np.asarray(array), name)


def weights(name="W", rows=OBSERVATION, columns=ACTION, seed=0):
    numbers = np.random.default_rng(seed).normal(size=(rows, columns))
    return tensor(name, numbers.astype(np.float32))


def model(
    nodes,
    tensors=(),
    *,
    inputs=None,
    outputs=None,
    opsets=(("", 17),),
    ir_version=8,
):
    """A model from `o` [batch, 4] to `a` [batch, 2], by default."""
    graph = helper.make_graph(
        nodes,
        "policy",
        [value("o", "batch", OBSERVATION)] if inputs is None else inputs,
        [value("a", "batch", ACTION)] if outputs is None else outputs,
        list(tensors),
    )
    imports = [helper.make_opsetid(*opset) for opset in opsets]
    return helper.make_model(graph, opset_imports=imports, ir_version=ir_version)


def linear(**changes):
    """a = o W: the smallest policy that is one."""
    return model([node("MatMul", "o W", "a")], [weights()], **changes)


def external(location):
    """The linear policy, with its weights in another file."""
    found = linear()
    W = found.graph.initializer[0]
    W.ClearField("raw_data")
    W.data_location = TensorProto.EXTERNAL
    W.external_data.add(key="location", value=location)
    return found


def squashed(nodes, tensors=(), **changes):
    """The linear policy as `y`, then some nodes from it to `a`."""
    return model([node("MatMul", "o W", "y"), *nodes], [weights(), *tensors], **changes)


def network(hidden=8, seed=0):
    """Two layers, clipped: with the bytes of an exported actor, but few of them."""
    return model(
        [
            node("Gemm", "o W1 b1", "h"),
            node("Tanh", "h", "t"),
            node("Gemm", "t W2 b2", "y"),
            node("Clip", "y low high", "a"),
        ],
        [
            weights("W1", OBSERVATION, hidden, seed),
            tensor("b1", np.zeros(hidden, np.float32)),
            weights("W2", hidden, ACTION, seed + 1),
            tensor("b2", np.full(ACTION, 0.5, np.float32)),
            tensor("low", np.float32(0)),
            tensor("high", np.float32(1)),
        ],
    )


def looping(times=2**62):
    """A loop whose condition stays true."""
    body = helper.make_graph(
        [node("Identity", "c", "c_out"), node("Sin", "x", "x_out")],
        "body",
        [
            value("i", type=TensorProto.INT64),
            value("c", type=TensorProto.BOOL),
            value("x", None, 2),
        ],
        [value("c_out", type=TensorProto.BOOL), value("x_out", None, 2)],
    )
    return squashed(
        [node("Loop", "times go y", "a", body=body)],
        [tensor("times", np.int64(times)), tensor("go", np.bool_(True))],
    )


def memory_bomb():
    """Some 200 bytes that ask for 4 GiB."""
    shape = tensor("shape", np.array([2**30], np.int64))
    return model(
        [
            node("ConstantOfShape", "shape", "z"),
            node("ReduceSum", "z", "s"),
            node("MatMul", "o W", "y"),
            node("Add", "y s", "a"),
        ],
        [shape, weights()],
    )


def doubling(times, axis=1):
    """An array that doubles again and again, by operators that the gate allows."""
    grown = ["y", *(f"y{i}" for i in range(times))]
    return squashed(
        [
            *(
                node("Concat", f"{before} {before}", after, axis=axis)
                for before, after in itertools.pairwise(grown)
            ),
            node("ReduceMean", grown[-1], "mean", axes=[1], keepdims=1),
            node("Add", "y mean", "a"),
        ]
    )
