"""The gate: good files pass, and each kind of bad one is refused with its own code."""

from __future__ import annotations

import io
import itertools
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from onnx import TensorProto, helper

import sme_registry
from leaderboard.artefact.gate import MAX_FIELDS, MAX_NAME, MAX_NODES, inspect
from leaderboard.artefact.sandbox import Sandbox
from leaderboard.documents.submission import MAX_ARTEFACT_BYTES
from leaderboard.errors import Rejection
from sme_registry import SMESpec
from tests.leaderboard.artefact import models
from tests.leaderboard.artefact.models import (
    ACTION,
    OBSERVATION,
    linear,
    model,
    network,
    node,
    squashed,
    tensor,
    value,
    weights,
)


def rejection(found):
    """How a model, or its bytes, is refused; in at most 32 calls of functions a field.

    Calls are counted, since a time also measures what else the machine does.
    """
    data = found if isinstance(found, bytes) else found.SerializeToString()
    calls = itertools.count()
    sys.setprofile(lambda *_: next(calls))
    try:
        with pytest.raises(Rejection) as caught:
            inspect(data, OBSERVATION, ACTION)
    finally:
        sys.setprofile(None)
    assert next(calls) < 32 * MAX_FIELDS
    assert caught.value.message.endswith(".")
    return caught.value


def accepted(found):
    inspect(found.SerializeToString(), OBSERVATION, ACTION)


def changed(found, change):
    change(found)
    return found


def test_a_network_is_accepted():
    accepted(network(hidden=8))


@pytest.mark.parametrize("opset", [13, 17, 23])
def test_every_opset_from_13_to_23_passes(opset):
    accepted(linear(opsets=[("", opset)]))


@pytest.mark.parametrize("domain", ["", "ai.onnx"])
def test_both_names_of_onnx_own_domain_pass(domain):
    accepted(linear(opsets=[(domain, 17)]))


@pytest.mark.parametrize("batch", ["batch", None, -1])
def test_a_batch_passes_as_a_symbol_unnamed_and_as_minus_one(batch):
    found = linear(inputs=[value("o", batch, 4)], outputs=[value("a", batch, 2)])
    accepted(found)
    with Sandbox(found.SerializeToString(), 4, 2) as policy:
        assert policy(np.ones((3, 4), np.float32)).shape == (3, 2)


def test_an_outputs_width_may_be_left_open():
    accepted(linear(outputs=[value("a", "batch", "actions")]))


@pytest.mark.parametrize("raw", [True, False])
@pytest.mark.parametrize(
    "type", [TensorProto.FLOAT, TensorProto.DOUBLE, TensorProto.INT32, TensorProto.INT64,
             TensorProto.BOOL], ids=TensorProto.DataType.Name
)  # fmt: skip
def test_tensors_pass_as_raw_bytes_and_as_lists_of_numbers(type, raw):
    numbers = np.ones((2, 3), helper.tensor_dtype_to_np_dtype(type))
    entry = helper.make_tensor("x", type, (2, 3), numbers.tobytes() if raw else numbers, raw)
    accepted(linear_with(entry))


def linear_with(*tensors):
    return model([node("MatMul", "o W", "a")], [weights(), *tensors])


def test_optional_inputs_may_be_empty_and_outputs_announced():
    bounded = [node_with("Clip", ["y", "", "high"], ["c"]), node("Tanh", "c", "a")]
    accepted(squashed(bounded, [tensor("high", np.float32(1))]))
    accepted(split(2, num_outputs=2))
    accepted(changed(split(2), lambda m: setattr(m.opset_import[0], "version", 17)))
    lengths = [node_with("Split", ["y", "s"], ["a", "b"], axis=1)]
    accepted(squashed(lengths, [tensor("s", np.int64([1, 1]))], opsets=[("", 18)]))


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("algorithm", ["PPO", "TD3", "SAC"])
def test_exported_stable_baselines3_actors_pass_and_act_as_before(torch, algorithm):
    sb3 = pytest.importorskip("stable_baselines3")
    spec = SMESpec(state_dim=2, action_dim=2)
    env = sme_registry.make(spec, action_range="symmetric")
    policy = getattr(sb3, algorithm)("MlpPolicy", env, device="cpu", seed=1).policy.eval()

    class Actor(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.policy = policy

        def forward(self, observations):
            if algorithm == "PPO":
                latent = self.policy.mlp_extractor.forward_actor(observations)
                action = self.policy.action_net(latent)
            elif algorithm == "SAC":
                action = torch.tanh(self.policy.actor.mu(self.policy.actor.latent_pi(observations)))
            else:
                action = self.policy.actor.mu(observations)
            return (torch.clamp(action, -1.0, 1.0) + 1.0) / 2.0

    file, actor = io.BytesIO(), Actor()
    torch.onnx.export(
        actor,
        (torch.zeros(1, 4),),
        file,
        dynamo=False,
        input_names=["o"],
        output_names=["a"],
        dynamic_axes={"o": {0: "batch"}, "a": {0: "batch"}},
    )
    o = np.random.default_rng(0).random((64, 4), np.float32)
    with Sandbox(file.getvalue(), 4, 2) as exported, torch.no_grad():
        np.testing.assert_allclose(exported(o), actor(torch.as_tensor(o)).numpy(), atol=1e-6)
        exported.check_rows(o)


REFUSED_OPERATORS = """
    RandomUniformLike RandomNormal Bernoulli Multinomial Dropout Loop If Scan SequenceAt
    SequenceEmpty Optional StringNormalizer TfIdfVectorizer ConstantOfShape Expand Tile Range Resize
    Pad Shape Size NonZero OneHot Einsum LSTM CumSum EyeLike
"""


@pytest.mark.parametrize("operator", REFUSED_OPERATORS.split())
def test_operators_that_are_random_looping_growing_or_textual_are_refused(operator):
    found = rejection(squashed([node(operator, "y", "a")]))
    assert found.code == "onnx_op"
    assert repr(operator) in found.message


def many_nodes(count):
    names = ["y", *(f"y{i}" for i in range(count - 2)), "a"]
    return squashed([node("Tanh", x, y) for x, y in itertools.pairwise(names)])


def test_as_many_nodes_as_are_allowed_pass():
    accepted(many_nodes(MAX_NODES))


def attributed(**attributes):
    """The linear policy with an attribute; the type and the value may be set apart."""
    found = squashed([node("Flatten", "y", "a", axis=1)])
    attribute = found.graph.node[1].attribute[0]
    for field, content in attributes.items():
        if isinstance(content, list):
            getattr(attribute, field).extend(content)
        elif hasattr(content, "SerializeToString"):
            getattr(attribute, field).CopyFrom(content)
        else:
            setattr(attribute, field, content)
    return found


def with_tensor(**fields):
    found = linear()
    for field, content in fields.items():
        broken = found.graph.initializer[0]
        if field == "dims":
            broken.ClearField("dims")
        if isinstance(content, list):
            getattr(broken, field).extend(content)
        else:
            setattr(broken, field, content)
    return found


def external():
    found = linear()
    W = found.graph.initializer[0]
    W.ClearField("raw_data")
    W.data_location = TensorProto.EXTERNAL
    W.external_data.add(key="location", value="../../etc/passwd")
    return found


def sparse():
    found = linear()
    found.graph.sparse_initializer.add(dims=[2**40], values=tensor("S", np.ones(1, np.float32)))
    return found


def node_with(operator, inputs, outputs=("a",), **attributes):
    """A node whose names may be empty."""
    return helper.make_node(operator, inputs, outputs, **attributes)


def split(outputs, **attributes):
    names = [f"part{i}" for i in range(outputs)]
    nodes = [node_with("Split", ["y"], names, axis=1, **attributes), node("Tanh", "y", "a")]
    return squashed(nodes, opsets=[("", 18)])


def twice_attributed():
    found = squashed([node("Flatten", "y", "a", axis=1)])
    flatten = found.graph.node[1]
    flatten.attribute.append(flatten.attribute[0])
    return found


GRAPH = helper.make_graph([], "empty", [], [])
VERSION_14 = linear(ir_version=14)

BAD = {
    "not an ONNX file": (b"hello, world", "onnx_malformed"),
    "nothing": (b"", "onnx_version"),
    "a .zip": (b"PK\x03\x04" + bytes(100), "onnx_malformed"),
    "a truncated file": (network().SerializeToString()[:-1], "onnx_malformed"),
    "no graph": (changed(linear(), lambda m: m.ClearField("graph")), "onnx_malformed"),
    "an unknown field": (linear().SerializeToString() + b"\xf8\x07\x01", "onnx_malformed"),
    "two graphs": (linear().SerializeToString() * 2, "onnx_malformed"),
    "an opset too old": (linear(opsets=[("", 12)]), "onnx_version"),
    "an opset too new": (linear(opsets=[("", 24)]), "onnx_version"),
    "an IR too old": (linear(ir_version=3), "onnx_version"),
    "an IR too new": (VERSION_14, "onnx_version"),
    "no opset": (linear(opsets=[]), "onnx_domain"),
    "two domains": (linear(opsets=[("", 17), ("com.microsoft", 1)]), "onnx_domain"),
    "two opsets": (linear(opsets=[("", 17), ("", 18)]), "onnx_domain"),
    "another domain": (linear(opsets=[("ai.onnx.ml", 3)]), "onnx_domain"),
    "an operator of Microsoft": (
        squashed([node("FusedGemm", "y", "a", domain="com.microsoft")]), "onnx_domain"
    ),
    "an operator of ONNX's name in another domain": (
        squashed([node("Tanh", "y", "a", domain="com.microsoft")]), "onnx_domain"
    ),
    "an operator's name with a space": (squashed([node("Tanh ", "y", "a")]), "onnx_op"),
    "a memory bomb": (models.memory_bomb(), "onnx_op"),
    "an endless loop": (models.looping(), "onnx_op"),
    "a subgraph in an operator of the list": (attributed(g=GRAPH), "onnx_subgraph"),
    "subgraphs in an operator of the list": (attributed(graphs=[GRAPH]), "onnx_subgraph"),
    "a function's attribute": (attributed(ref_attr_name="x"), "onnx_subgraph"),
    "a function": (changed(linear(), lambda m: m.functions.add(name="f")), "onnx_subgraph"),
    "an overload": (changed(linear(), lambda m: setattr(m.graph.node[0], "overload", "f")),
                    "onnx_subgraph"),
    "training information": (changed(linear(), lambda m: m.training_info.add()), "onnx_subgraph"),
    "external data": (external(), "onnx_external_data"),
    "a place outside alone": (with_tensor(data_location=1), "onnx_external_data"),
    "a sparse initialiser": (sparse(), "onnx_tensor"),
    "a sparse attribute": (
        attributed(sparse_tensor=helper.make_sparse_tensor(
            tensor("v", np.ones(1, np.float32)), tensor("i", np.zeros(1, np.int64)), [4])),
        "onnx_tensor",
    ),
    "a type as an attribute": (
        attributed(tp=helper.make_tensor_type_proto(1, [2])), "onnx_tensor"
    ),
    "an attribute of two values": (attributed(f=1.0), "onnx_malformed"),
    "an attribute of another type": (attributed(type=3), "onnx_malformed"),
    "an attribute of no type": (attributed(type=0), "onnx_malformed"),
    "huge dimensions": (with_tensor(dims=[2**40, 2**40]), "onnx_tensor"),
    "dimensions whose product overflows to none": (
        with_tensor(raw_data=b"", dims=[2**32, 2**32, 0]), "onnx_tensor"
    ),
    "a negative dimension": (with_tensor(dims=[-4, -2]), "onnx_tensor"),
    "too many dimensions": (with_tensor(dims=[1] * 9), "onnx_tensor"),
    "less data than the dimensions": (with_tensor(dims=[4, 3]), "onnx_tensor"),
    "more data than the dimensions": (with_tensor(dims=[4, 1]), "onnx_tensor"),
    "half an entry": (with_tensor(raw_data=b"\0" * 31), "onnx_malformed"),
    "data given twice": (with_tensor(float_data=[0.0] * 8), "onnx_tensor"),
    "data of another type": (with_tensor(raw_data=b"", int64_data=[0] * 8), "onnx_tensor"),
    "text in a tensor": (linear_with(tensor("x", np.array(["a"], object))), "onnx_tensor"),
    "a tensor of float16": (linear_with(tensor("x", np.ones(2, np.float16))), "onnx_tensor"),
    "a tensor of complex numbers": (linear_with(tensor("x", np.ones(2, np.complex64))),
                                    "onnx_tensor"),
    "a cast to text": (squashed([node("Cast", "y", "a", to=TensorProto.STRING)]), "onnx_tensor"),
    **{
        f"an empty input of {operator}": (squashed([node_with(operator, ["y", "", "y"])]),
                                          "onnx_malformed")
        for operator in ("Sum", "Mean", "Min", "Max", "Concat", "Where")
    },
    "a first input that is empty": (squashed([node_with("Clip", ["", "y"])]), "onnx_malformed"),
    "an empty output": (squashed([node("Tanh", "y", "a"), node_with("Tanh", ["y"], [""])]),
                        "onnx_malformed"),
    "no output": (squashed([node("Tanh", "y", "a"), node_with("Tanh", ["y"], [])]),
                  "onnx_malformed"),
    "fewer outputs announced than there are": (split(3, num_outputs=2), "onnx_malformed"),
    "more outputs announced than there are": (split(3, num_outputs=4), "onnx_malformed"),
    "outputs that nothing announces": (split(3), "onnx_malformed"),
    "a second output without a name": (
        squashed([node_with("Split", ["y"], ["q", ""], axis=1, num_outputs=2),
                  node("Tanh", "q", "a")], opsets=[("", 18)]), "onnx_malformed"),
    "an attribute given twice": (twice_attributed(), "onnx_malformed"),
    "a value computed twice": (squashed([node("Tanh", "y", "a"), node("Tanh", "y", "a")]),
                               "onnx_malformed"),
    "a value computed and stored": (
        squashed([node("Tanh", "y", "a")], [tensor("y", np.ones((1, 2), np.float32))]),
        "onnx_malformed",
    ),
    "a value stored twice": (linear_with(weights()), "onnx_malformed"),
    "a tensor without a name": (linear_with(weights("")), "onnx_malformed"),
    "observations that are stored": (linear_with(weights("o")), "onnx_malformed"),
    "too many nodes": (many_nodes(MAX_NODES + 1), "onnx_too_many_nodes"),
    "too many tensors": (
        linear_with(*(tensor(f"x{i}", np.float32(0)) for i in range(4096))), "onnx_too_many_nodes"
    ),
    "too many attributes": (
        squashed([node("Flatten", "y", "a", **{f"x{i}": i for i in range(8193)})]),
        "onnx_too_many_nodes",
    ),
    "too long a name": (
        squashed([node("Tanh", "y", "z" * (MAX_NAME + 1)), node("Tanh", "y", "a")]),
        "onnx_too_many_nodes",
    ),
    "no input": (model([node("Identity", "W", "a")], [weights()], inputs=[]), "onnx_interface"),
    "two inputs": (linear(inputs=[value("o", "b", 4), value("p", "b", 4)]), "onnx_interface"),
    "two outputs": (linear(outputs=[value("a", "b", 2), value("o", "b", 4)]), "onnx_interface"),
    "an input too wide": (linear(inputs=[value("o", "b", 5)]), "onnx_interface"),
    "an input of any width": (linear(inputs=[value("o", "b", "w")]), "onnx_interface"),
    "an output too narrow": (linear(outputs=[value("a", "b", 1)]), "onnx_interface"),
    "a batch of one": (linear(inputs=[value("o", 1, 4)]), "onnx_interface"),
    "an output of one row": (linear(outputs=[value("a", 1, 2)]), "onnx_interface"),
    "an input of three axes": (linear(inputs=[value("o", "b", 1, 4)]), "onnx_interface"),
    "an input of float64": (linear(inputs=[value("o", "b", 4, type=TensorProto.DOUBLE)]),
                            "onnx_interface"),
    "an output of int64": (linear(outputs=[value("a", "b", 2, type=TensorProto.INT64)]),
                           "onnx_interface"),
    "an input that is a sequence": (
        linear(inputs=[helper.make_tensor_sequence_value_info("o", 1, ["b", 4])]), "onnx_interface"
    ),
    "an input without a type": (
        changed(linear(), lambda m: m.graph.input[0].ClearField("type")), "onnx_interface"
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_file_is_rejected_with_its_code(kind):
    found, code = BAD[kind]
    assert rejection(found).code == code


def test_every_truncation_of_a_good_file_is_refused():
    data = network().SerializeToString()
    for length in range(len(data)):
        rejection(data[:length])


def test_a_file_above_the_size_limit_is_rejected_unread():
    assert rejection(bytes(MAX_ARTEFACT_BYTES + 1)).code == "too_large"


def length_prefixed(tag, content):
    size, digits = len(content), b""
    while size >= 0x80:
        digits += bytes([size & 0x7F | 0x80])
        size >>= 7
    return bytes([tag]) + digits + bytes([size]) + content


HEAD = b"\x08\x08\x42\x04\x0a\x00\x10\x11"  # IR version 8, opset 17
FULL = MAX_ARTEFACT_BYTES - 100
FLOODS = {
    "of fields": b"\x32\x00" * (FULL // 2),
    "of metadata": HEAD + b"\x72\x00" * (FULL // 2),
    "of nodes": HEAD + length_prefixed(0x3A, b"\x0a\x00" * (FULL // 2)),
    "of tensors": HEAD + length_prefixed(0x3A, b"\x2a\x00" * (FULL // 2)),
    "of value types": HEAD + length_prefixed(0x3A, b"\x6a\x00" * (FULL // 2)),
    "of dimensions": HEAD
    + length_prefixed(0x3A, length_prefixed(0x2A, b"\x10\x01" + b"\x08\x01" * (FULL // 2))),
    "of packed dimensions": HEAD
    + length_prefixed(
        0x3A, length_prefixed(0x2A, b"\x10\x01" + length_prefixed(0x0A, b"\x01" * FULL))
    ),
    "of packed integers": HEAD
    + length_prefixed(
        0x3A, length_prefixed(0x2A, b"\x10\x07\x08\x01" + length_prefixed(0x3A, b"\x01" * FULL))
    ),
    "of one long number": b"\xff" * FULL,
    "of names": HEAD
    + length_prefixed(0x3A, length_prefixed(0x0A, b"\x22\x04Tanh" + b"\x0a\x00" * (FULL // 2))),
    "of messages in messages": HEAD
    + length_prefixed(
        0x3A, length_prefixed(0x5A, length_prefixed(0x12, b"\x0a\x00" * (FULL // 2)))
    ),
}


@pytest.mark.parametrize("kind", FLOODS)
def test_a_flood_is_refused_with_little_work_and_in_little_memory(kind):
    data = FLOODS[kind]
    assert len(data) <= MAX_ARTEFACT_BYTES
    assert rejection(data).code in ("onnx_too_many_nodes", "onnx_malformed", "onnx_tensor")
    tracemalloc.start()
    try:
        with pytest.raises(Rejection):
            inspect(data, OBSERVATION, ACTION)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 32 * 2**20


def test_deep_nesting_is_rejected_without_recursion():
    inner = b""
    for _ in range(2000):
        inner = length_prefixed(0x32, length_prefixed(0x0A, length_prefixed(0x2A, inner)))
    data = HEAD + length_prefixed(0x3A, inner)
    assert rejection(data).code == "onnx_malformed"


def test_names_in_messages_are_printable():
    found = rejection(squashed([node("\x1b[2J<script>\n", "y", "a")]))
    assert "\x1b" not in found.message
    assert "\n" not in found.message


def test_inspecting_loads_no_runtime():
    script = (
        "import sys\n"
        "from leaderboard.artefact.gate import inspect\n"
        f"inspect({linear().SerializeToString()!r}, 4, 2)\n"
        "assert not {'onnx', 'onnxruntime', 'torch', 'google.protobuf'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


def test_the_budget_of_fields_leaves_room_for_the_largest_network():
    accepted(many_nodes(MAX_NODES))
    assert MAX_NODES * 20 < MAX_FIELDS
