"""The gate: good files pass, and each kind of bad one is refused with its own code."""

import itertools
import subprocess
import sys

import numpy as np
import pytest
from onnx import TensorProto, helper

from leaderboard.documents.submission import MAX_ARTEFACT_BYTES
from leaderboard.errors import CODES, Rejection
from leaderboard.gate import gate
from leaderboard.gate.gate import MAX_ENTRIES, MAX_FIELDS, MAX_NAME, MAX_NODES
from leaderboard.gate.sandbox import Confined, Sandbox, SandboxLimits, inspect_own
from tests.leaderboard.gate import models
from tests.leaderboard.gate.models import (
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
    """How a model, or its bytes, is refused."""
    data = found if isinstance(found, bytes) else found.SerializeToString()
    with pytest.raises(Rejection) as caught:
        inspect_own(data, OBSERVATION, ACTION)
    assert caught.value.message.endswith(".")
    return caught.value


def accepted(found):
    inspect_own(found.SerializeToString(), OBSERVATION, ACTION)


def changed(found, change):
    change(found)
    return found


def linear_with(*tensors):
    return model([node("MatMul", "o W", "a")], [weights(), *tensors])


def node_with(operator, inputs, outputs=("a",), **attributes):
    """A node whose names may be empty."""
    return helper.make_node(operator, inputs, outputs, **attributes)


def split(outputs, **attributes):
    names = [f"part{i}" for i in range(outputs)]
    nodes = [node_with("Split", ["y"], names, axis=1, **attributes), node("Tanh", "y", "a")]
    return squashed(nodes, opsets=[("", 18)])


def many_nodes(count):
    names = ["y", *(f"y{i}" for i in range(count - 2)), "a"]
    return squashed([node("Tanh", x, y) for x, y in itertools.pairwise(names)])


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


def sparse():
    found = linear()
    found.graph.sparse_initializer.add(dims=[2**40], values=tensor("S", np.ones(1, np.float32)))
    return found


def test_networks_of_every_opset_and_form_are_accepted():
    for opset in (13, 17, 23):
        accepted(linear(opsets=[("", opset)]))
    accepted(linear(opsets=[("ai.onnx", 17)]))
    accepted(network(hidden=8))
    accepted(linear(outputs=[value("a", "batch", "actions")]))
    bounded = [node_with("Clip", ["y", "", "high"], ["c"]), node("Tanh", "c", "a")]
    accepted(squashed(bounded, [tensor("high", np.float32(1))]))
    accepted(split(2, num_outputs=2))
    accepted(changed(split(2), lambda m: setattr(m.opset_import[0], "version", 17)))
    lengths = [node_with("Split", ["y", "s"], ["a", "b"], axis=1)]
    accepted(squashed(lengths, [tensor("s", np.int64([1, 1]))], opsets=[("", 18)]))
    listed = [node("Constant", "", "c", value_floats=[1.0, -2.0]), node("Tanh", "y", "a")]
    accepted(squashed(listed))
    accepted(many_nodes(MAX_NODES))
    assert MAX_NODES * 20 < MAX_FIELDS  # the budget leaves room for the largest network


def test_a_batch_passes_as_a_symbol_unnamed_and_as_minus_one():
    for batch in ("batch", None, -1):
        found = linear(inputs=[value("o", batch, 4)], outputs=[value("a", batch, 2)])
        accepted(found)
    with Sandbox(found.SerializeToString(), 4, 2) as policy:
        assert policy(np.ones((3, 4), np.float32)).shape == (3, 2)


def test_tensors_pass_as_raw_bytes_and_as_lists_of_numbers():
    for type in ("FLOAT", "DOUBLE", "INT32", "INT64", "BOOL"):
        code = TensorProto.DataType.Value(type)
        numbers = np.full((2, 3), -1).astype(helper.tensor_dtype_to_np_dtype(code))
        accepted(linear_with(helper.make_tensor("x", code, (2, 3), numbers.tobytes(), True)))
        accepted(linear_with(helper.make_tensor("x", code, (2, 3), numbers, False)))


REFUSED_OPERATORS = """
    RandomUniformLike RandomNormal Bernoulli Multinomial Dropout Loop If Scan SequenceAt
    SequenceEmpty Optional StringNormalizer TfIdfVectorizer ConstantOfShape Expand Tile Range Resize
    Pad Shape Size NonZero OneHot Einsum LSTM CumSum EyeLike
"""


def test_operators_that_are_random_looping_growing_or_textual_are_refused():
    for operator in REFUSED_OPERATORS.split():
        found = rejection(squashed([node(operator, "y", "a")]))
        assert found.code == "onnx_op"
        assert repr(operator) in found.message
    hidden = rejection(squashed([node("\x1b[2J<script>\n", "y", "a")])).message
    assert "\x1b" not in hidden
    assert "\n" not in hidden


def reordered(found):
    nodes = list(found.graph.node)
    del found.graph.node[:]
    found.graph.node.extend(reversed(nodes))
    return found


def model_last(found):
    """The same model for every reader, but not the bytes that a writer makes of it."""
    version = found.SerializeToString()[:2]
    return found.SerializeToString()[2:] + version


def nested(depth):
    inner = b""
    for _ in range(depth):
        inner = length_prefixed(0x32, length_prefixed(0x0A, length_prefixed(0x2A, inner)))
    return file_of(inner)


def length_prefixed(tag, content):
    size, digits = len(content), b""
    while size >= 0x80:
        digits += bytes([size & 0x7F | 0x80])
        size >>= 7
    return bytes([tag]) + digits + bytes([size]) + content


def file_of(graph):
    """The canonical bytes of a model of IR version 8 and opset 17, of the bytes of its graph."""
    return b"\x08\x08" + length_prefixed(0x3A, graph) + b"\x42\x04\x0a\x00\x10\x11"


GRAPH = helper.make_graph([], "empty", [], [])
ONES = np.ones(1, np.float32)

BAD = {
    "onnx_malformed": {
        "not an ONNX file": b"hello, world",
        "no graph": changed(linear(), lambda m: m.ClearField("graph")),
        "an unknown field": linear().SerializeToString() + b"\xf8\x07\x01",
        "two graphs": linear().SerializeToString() * 2,
        "an attribute of two values": attributed(f=1.0),
        "an attribute of another type": attributed(type=3),
        "an empty input of a sum": squashed([node_with("Sum", ["y", "", "y"])]),
        "no output": squashed([node("Tanh", "y", "a"), node_with("Tanh", ["y"], [])]),
        "fewer outputs announced than there are": split(3, num_outputs=2),
        "outputs that nothing announces": split(3),
        "a value computed twice": squashed([node("Tanh", "y", "a"), node("Tanh", "y", "a")]),
        "a value computed and stored": squashed([node("Tanh", "y", "a")], [tensor("y", ONES)]),
        "observations that are stored": linear_with(weights("o")),
        "a value that nothing computes": model([node("MatMul", "o Q", "a")], [weights()]),
        "values used before they are computed": reordered(network()),
        "another order of fields": model_last(linear()),
        "a length in more bytes than it needs": b"\x08\x88\x00" + linear().SerializeToString()[2:],
        "a name that is not UTF-8": linear().SerializeToString().replace(b"policy", b"polic\xff"),
        "messages nested deeper than any reader's stack": nested(2000),
    },
    "onnx_version": {
        "nothing": b"",
        "an opset too old": linear(opsets=[("", 12)]),
        "an opset too new": linear(opsets=[("", 24)]),
        "an IR too old": linear(ir_version=3),
        "an IR too new": linear(ir_version=14),
    },
    "onnx_domain": {
        "no opset": linear(opsets=[]),
        "two opsets": linear(opsets=[("", 17), ("", 18)]),
        "a known operator elsewhere": squashed([node("Tanh", "y", "a", domain="com.microsoft")]),
    },
    "onnx_op": {
        "an operator's name with a space": squashed([node("Tanh ", "y", "a")]),
    },
    "onnx_subgraph": {
        "an endless loop": models.looping(),
        "a subgraph in an operator of the list": attributed(g=GRAPH),
        "a function's attribute": attributed(ref_attr_name="x"),
        "a function": changed(linear(), lambda m: m.functions.add(name="f")),
        "an overload": changed(linear(), lambda m: setattr(m.graph.node[0], "overload", "f")),
        "training information": changed(linear(), lambda m: m.training_info.add()),
    },
    "onnx_external_data": {
        "external data": models.external("../../etc/passwd"),
        "a place outside alone": with_tensor(data_location=1),
    },
    "onnx_tensor": {
        "a sparse initialiser": sparse(),
        "a type as an attribute": attributed(tp=helper.make_tensor_type_proto(1, [2])),
        "huge dimensions": with_tensor(dims=[2**40, 2**40]),
        "dimensions whose product overflows": with_tensor(raw_data=b"", dims=[2**32, 2**32, 0]),
        "a negative dimension": with_tensor(dims=[-4, -2]),
        "too many dimensions": with_tensor(dims=[1] * 9),
        "half an entry": with_tensor(raw_data=b"\0" * 31),
        "less data than the dimensions": with_tensor(dims=[4, 3]),
        "more data than the dimensions": with_tensor(dims=[4, 1]),
        "data given twice": with_tensor(float_data=[0.0] * 8),
        "data of another type": with_tensor(raw_data=b"", int64_data=[0] * 8),
        "a tensor of float16": linear_with(tensor("x", np.ones(2, np.float16))),
        "a cast to text": squashed([node("Cast", "y", "a", to=TensorProto.STRING)]),
    },
    "onnx_too_many_nodes": {
        "too many nodes": many_nodes(MAX_NODES + 1),
        "too many tensors": linear_with(*(tensor(f"x{i}", np.float32(0)) for i in range(4096))),
        "too long a name": squashed(
            [node("Tanh", "y", "z" * (MAX_NAME + 1)), node("Tanh", "y", "a")]
        ),
    },
    "onnx_interface": {
        "no input": model([node("Identity", "W", "a")], [weights()], inputs=[]),
        "two inputs": linear(inputs=[value("o", "b", 4), value("p", "b", 4)]),
        "two outputs": linear(outputs=[value("a", "b", 2), value("o", "b", 4)]),
        "an input too wide": linear(inputs=[value("o", "b", 5)]),
        "an output too narrow": linear(outputs=[value("a", "b", 1)]),
        "a batch of one": linear(inputs=[value("o", 1, 4)]),
        "an input of three axes": linear(inputs=[value("o", "b", 1, 4)]),
        "an input of float64": linear(inputs=[value("o", "b", 4, type=TensorProto.DOUBLE)]),
        "an input that is a sequence": linear(
            inputs=[helper.make_tensor_sequence_value_info("o", 1, ["b", 4])]
        ),
        "an input without a type": changed(linear(), lambda m: m.graph.input[0].ClearField("type")),
    },
    "too_large": {"a file above the size limit": bytes(MAX_ARTEFACT_BYTES + 1)},
}


@pytest.mark.parametrize("code", BAD)
def test_bad_files_are_rejected_with_their_code(code):
    codes = {kind: rejection(found).code for kind, found in BAD[code].items()}
    assert codes == dict.fromkeys(BAD[code], code)


def test_every_truncation_and_mutation_of_a_good_file_is_refused_or_read():
    data = network(hidden=4).SerializeToString()
    for length in range(len(data)):
        rejection(data[:length])
    codes = set()
    for at, change in itertools.product(range(len(data)), (0x01, 0x80)):
        mutant = data[:at] + bytes([data[at] ^ change]) + data[at + 1 :]
        try:
            inspect_own(mutant, OBSERVATION, ACTION)
            codes.add("accepted")
        except Rejection as refused:
            codes.add(refused.code)
    assert {"accepted", "onnx_malformed", "onnx_tensor"} <= codes <= {"accepted", *CODES}


SIZE = MAX_ARTEFACT_BYTES - 100
FLOODS = {
    "values": lambda: file_of(b"\x6a\x00" * (SIZE // 2)),
    "names": lambda: file_of(length_prefixed(0x0A, b"\x0a\x00" * (SIZE // 2))),
    "metadata": lambda: file_of(b"") + b"\x72\x00" * (SIZE // 2),
    "tensors": lambda: file_of(b"\x2a\x00" * (SIZE // 2)),
    "dimensions": lambda: file_of(length_prefixed(0x2A, b"\x08\x01" * (SIZE // 2) + b"\x10\x01")),
    "packed integers": lambda: file_of(
        length_prefixed(0x2A, b"\x08\x01\x10\x07" + length_prefixed(0x3A, b"\x01" * SIZE))
    ),
    "messages in messages": lambda: file_of(
        length_prefixed(0x5A, length_prefixed(0x12, b"\x0a\x00" * (SIZE // 2)))
    ),
    "one long number": lambda: b"\xff" * SIZE,
}


@pytest.mark.parametrize("kind", FLOODS)
def test_a_flood_is_refused_by_the_child_in_seconds(kind):
    with Confined(SandboxLimits(cpu_seconds=15)) as child, pytest.raises(Rejection) as caught:
        child.inspect(FLOODS[kind](), OBSERVATION, ACTION)
    assert caught.value.code in ("onnx_too_many_nodes", "onnx_malformed", "onnx_tensor")


def test_the_child_reads_one_file_after_another_with_the_verdicts_of_the_gate():
    with Confined() as child:
        for _ in range(2):
            child.inspect(network().SerializeToString(), OBSERVATION, ACTION)
        child.inspect(linear().SerializeToString(), OBSERVATION, ACTION)
        bad = squashed([node("\x1b[2J<script>\n", "y", "a")])
        with pytest.raises(Rejection) as caught:
            child.inspect(bad.SerializeToString(), OBSERVATION, ACTION)
    assert (caught.value.code, "\x1b" in caught.value.message) == ("onnx_op", False)


def test_constants_agree_with_the_boards():
    assert MAX_ENTRIES == MAX_ARTEFACT_BYTES
    assert set(gate._CODES.values()) <= set(gate._REMEDIES) <= set(CODES)


def test_scoring_loads_no_parser_and_nothing_needs_posix_to_be_imported():
    script = (
        "import signal, sys\n"
        "sys.modules |= dict.fromkeys(('fcntl', 'resource', 'termios', 'pwd', 'grp'))\n"
        "for name in ('SIGXCPU', 'SIGKILL', 'SIGHUP'): delattr(signal, name)\n"
        "import leaderboard.bundle, leaderboard.gate.sandbox, leaderboard.scoring.score\n"
        "from leaderboard.admission import admit\n"
        "assert not {'onnx', 'onnxruntime', 'torch', 'google.protobuf'} & set(sys.modules)\n"
        "from leaderboard.gate.sandbox import inspect_own\n"
        f"inspect_own({linear().SerializeToString()!r}, 4, 2)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=300)
