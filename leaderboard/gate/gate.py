"""The gate: which ONNX files are policies. Only the confined child reads strangers' files with it.

    bytes         exactly those that protobuf writes of what it reads, so all readers see the same
    allow-list    fields, operators, types of tensors, shapes; everything else has a code
    structure     one source of each value; then ONNX's own checker

The child runs this file by its path: nothing here imports this package. What the listed operators
can still do (grow, run long, mix the rows of a batch) the sandbox detects. Crafted 8 MiB take up
to 650 MiB to parse, and are counted before anything iterates over them.

Source: onnx.proto, the definition of the format.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Collection
from math import prod
from typing import Any, NoReturn

IR_VERSIONS = range(4, 14)  # before 4 every tensor had to be an input, too
OPSETS = range(13, 24)

MAX_NODES = 2048
MAX_TENSORS = 4096
MAX_ATTRIBUTES = 8192
MAX_FIELDS = 65_536
"""Messages and texts in a file."""

MAX_NAME = 256
MAX_RANK = 8
MAX_ENTRIES = 2**23
"""Of a tensor."""

_FIELDS = {
    message: frozenset(fields.split())
    for message, fields in {
        "ModelProto": """
            ir_version opset_import producer_name producer_version domain model_version doc_string
            graph metadata_props
        """,
        "OperatorSetIdProto": "domain version",
        "GraphProto": "name doc_string node initializer input output value_info metadata_props",
        "NodeProto": "name op_type domain doc_string input output attribute metadata_props",
        "AttributeProto": "name type doc_string f i s t floats ints strings",
        "TensorProto": """
            name data_type dims doc_string raw_data float_data int32_data int64_data double_data
            data_location metadata_props
        """,
        "ValueInfoProto": "name type doc_string metadata_props",
        "TypeProto": "tensor_type denotation",
        "Tensor": "elem_type shape",
        "TensorShapeProto": "dim",
        "Dimension": "dim_value dim_param denotation",
        "StringStringEntryProto": "key value",
    }.items()
}
_TEXTS = ("doc_string", "key", "value")  # of any length, since nobody reads them

_CODES = {  # of fields that are not listed; of all others, "onnx_malformed"
    field: code
    for code, fields in {
        "onnx_subgraph": "functions training_info overload g graphs ref_attr_name",
        "onnx_tensor": """
            sparse_initializer sparse_tensor sparse_tensors tensors tp type_protos segment
            string_data uint64_data quantization_annotation
        """,
        "onnx_interface": "sequence_type map_type optional_type opaque_type sparse_tensor_type",
        "onnx_external_data": "external_data",
    }.items()
    for field in fields.split()
}
_REMEDIES = {
    "onnx_malformed": "Export it again, or load and save it with the package onnx",
    "onnx_version": "Export it with opset_version=17 and the matching IR version",
    "onnx_domain": "Export the network to standard operators only",
    "onnx_op": "Export the deterministic actor alone with `sme_registry.export_onnx`, which "
    "removes what it can and says how to rewrite the rest",
    "onnx_subgraph": "Export the network alone, its functions inlined",
    "onnx_external_data": "Export with external_data=False",
    "onnx_tensor": "Export the network, or a smaller one, in float32 with dense tensors",
    "onnx_too_many_nodes": "Submit a smaller network, with short names",
    "onnx_interface": "Export the actor with one input and output, its batch a dynamic axis, for "
    "this task",
}

# The name, bytes of an entry, and field of data that is not raw, of each type of tensors.
_TYPES = {
    1: ("float32", 4, "float_data"),
    6: ("int32", 4, "int32_data"),
    7: ("int64", 8, "int64_data"),
    9: ("bool", 1, "int32_data"),
    11: ("float64", 8, "double_data"),
}
_DATA = ("raw_data", "float_data", "int32_data", "int64_data", "double_data")
_FLOAT = 1
_ONNX_DOMAINS = ("", "ai.onnx")


class Refused(Exception):
    """A file is no policy: a code of `errors.CODES`, and what is wrong, allowed, and to do."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(code, message)
        self.code, self.message = code, message


def read(data: bytes, observation_dim: int, action_dim: int, operators: Collection[str]) -> Any:
    """The model in a file, a feed-forward network of these widths and operators."""
    import onnx
    from google.protobuf.message import DecodeError

    model = onnx.ModelProto()
    try:
        model.ParseFromString(data)
    except DecodeError:
        _refuse_bytes("not a protobuf message")
    model.DiscardUnknownFields()  # they would be written again
    if model.SerializeToString(deterministic=True) != data:
        _refuse_bytes("not the bytes that protobuf writes of this model")
    try:
        _check(model, observation_dim, action_dim, operators)
        onnx.checker.check_model(model)
    except onnx.checker.ValidationError as error:
        _refuse_bytes(str(error).partition("\n")[0][:200])
    return model


def numbers(model: Any) -> bytes:
    """The network of a model, as JSON for `explorers.network_of`."""
    import onnx

    def tensor(value: Any) -> dict[str, Any]:
        array = onnx.numpy_helper.to_array(value)
        data = base64.b64encode(array.tobytes()).decode()
        return {"type": array.dtype.str, "shape": array.shape, "data": data}

    def attribute(field: Any) -> Any:
        value = onnx.helper.get_attribute_value(field)
        if isinstance(value, onnx.TensorProto):
            return tensor(value)
        if field.type in (onnx.AttributeProto.STRING, onnx.AttributeProto.STRINGS):
            return None
        return value if isinstance(value, int | float) else list(value)

    graph = model.graph
    network = {
        "input": graph.input[0].name,
        "output": graph.output[0].name,
        "constants": {each.name: tensor(each) for each in graph.initializer},
        "nodes": [
            {
                "operator": node.op_type,
                "inputs": list(node.input),
                "outputs": list(node.output),
                "attributes": {field.name: attribute(field) for field in node.attribute},
            }
            for node in graph.node
        ],
    }
    return json.dumps(network).encode()


def _check(model: Any, observation_dim: int, action_dim: int, operators: Collection[str]) -> None:
    graph = model.graph
    _limit("nodes", len(graph.node), MAX_NODES)
    _limit("tensors", len(graph.initializer), MAX_TENSORS)
    _limit("attributes", sum(len(node.attribute) for node in graph.node), MAX_ATTRIBUTES)
    _check_fields(model)
    _check_versions(model)
    if not model.HasField("graph"):
        _refuse_bytes("no graph")
    sources = [value.name for value in graph.input]
    sources += [tensor.name for tensor in graph.initializer]
    for node in graph.node:
        _check_node(node, operators, model.opset_import[0].version)
        sources += node.output
    if "" in sources or len(set(sources)) < len(sources):
        _refuse_bytes("a value that has no name or two sources")
    _check_interface("input", graph.input, (observation_dim,))
    _check_interface("output", graph.output, (action_dim, None))


def _check_fields(model: Any) -> None:
    """Refuse fields that are not listed, and too many of them; check each tensor."""
    pending, count = [model], 0
    while pending:
        message = pending.pop()
        kind = message.DESCRIPTOR.name
        for field, value in message.ListFields():
            if field.name not in _FIELDS[kind]:
                _refuse(
                    _CODES.get(field.name, "onnx_malformed"), f"{kind}.{field.name}", "not allowed"
                )
            if field.message_type is None and field.type != field.TYPE_STRING:
                continue  # numbers, over which nothing iterates
            values = value if hasattr(value, "append") else [value]
            count += len(values)
            _limit("fields", count, MAX_FIELDS)
            if field.message_type is not None:
                pending.extend(values)
            elif field.name not in _TEXTS:
                if any(isinstance(text, bytes) for text in values):
                    _refuse_bytes(f"{kind}.{field.name} that is not UTF-8")
                longest = max(len(text.encode()) for text in values)
                _limit(f"bytes of a name in {kind}", longest, MAX_NAME)
        if kind == "TensorProto":
            _check_tensor(message)


def _check_versions(model: Any) -> None:
    if model.ir_version not in IR_VERSIONS:
        _refuse(
            "onnx_version",
            f"ir_version={model.ir_version}",
            f"must be in [{IR_VERSIONS[0]}, {IR_VERSIONS[-1]}]",
        )
    domains = [opset.domain for opset in model.opset_import]
    if len(domains) != 1 or domains[0] not in _ONNX_DOMAINS:
        _refuse(
            "onnx_domain",
            f"opset_import={[domain[:64] for domain in domains[:4]]}",
            "must be ONNX's own domain, '', once",
        )
    version = model.opset_import[0].version
    if version not in OPSETS:
        _refuse("onnx_version", f"opset={version}", f"must be in [{OPSETS[0]}, {OPSETS[-1]}]")


def _check_node(node: Any, operators: Collection[str], opset: int) -> None:
    operator = node.op_type[:64]
    if node.domain not in _ONNX_DOMAINS:
        _refuse(
            "onnx_domain",
            f"domain={node.domain[:64]!r} of operator {operator!r}",
            "must be ONNX's own, ''",
        )
    if node.op_type not in operators:
        _refuse(
            "onnx_op",
            f"op_type={operator!r}",
            'must be an operator of a feed-forward network (see the tutorial "Your own agent")',
        )
    attributes = {attribute.name: attribute.i for attribute in node.attribute}
    if len(attributes) < len(node.attribute):
        _refuse_bytes(f"two attributes of one name in {operator}")
    if operator == "Cast" and attributes.get("to") not in _TYPES:
        _refuse_type("to", attributes.get("to"), "Cast")
    if operator == "Sum" and "" in node.input:  # at which onnxruntime crashes
        _refuse_bytes("Sum of a value without a name")
    if operator == "Split":
        _check_split(node, attributes.get("num_outputs"), opset)


def _check_split(node: Any, announced: int | None, opset: int) -> None:
    """Require that a Split says how many outputs it has, which onnxruntime does not check."""
    outputs, has_lengths = len(node.output), any(node.input[1:])
    # Before opset 18 the attribute does not exist, and onnxruntime counts the outputs.
    missing = announced is None and not has_lengths and opset >= 18
    if missing or announced not in (None, outputs):
        _refuse_bytes(f"Split with {outputs} outputs and num_outputs={announced}")


def _check_tensor(tensor: Any) -> None:
    name = f"tensor {tensor.name[:64]!r}"
    if tensor.data_location != 0:
        _refuse(
            "onnx_external_data",
            f"data_location={tensor.data_location} of {name}",
            "must be inside the file",
        )
    if tensor.data_type not in _TYPES:
        _refuse_type("data_type", tensor.data_type, name)
    type_name, size, field = _TYPES[tensor.data_type]
    dims = list(tensor.dims[: MAX_RANK + 1])
    # Zeros count as ones, so that no reader's product of dimensions overflows.
    if (
        len(dims) > MAX_RANK
        or any(dim < 0 for dim in dims)
        or prod(max(dim, 1) for dim in dims) > MAX_ENTRIES
    ):
        _refuse(
            "onnx_tensor",
            f"dims={dims} of {name}",
            f"must be at most {MAX_RANK} non-negative lengths of at most {MAX_ENTRIES:,} entries",
        )
    held = [each for each in _DATA if len(getattr(tensor, each))]
    if len(held) > 1 or not set(held) <= {"raw_data", field}:
        _refuse(
            "onnx_tensor",
            f"{', '.join(held)} of {name}",
            f"must be either raw_data or {field} for {type_name}",
        )
    stored = sum(len(getattr(tensor, each)) for each in held)
    expected = prod(dims) * (size if held == ["raw_data"] else 1)
    if stored != expected:
        _refuse(
            "onnx_tensor",
            f"dims={dims} of {name}",
            f"must match its {held[0] if held else 'data'} of length {expected:,}, not {stored:,}",
        )


def _check_interface(what: str, values: Any, widths: tuple[int | None, ...]) -> None:
    """Require one float32 value `[batch, width]`; None among the widths is an open one."""
    allowed = f"must be one float32 {what} [batch, {widths[0]}]"
    if len(values) != 1:
        _refuse("onnx_interface", f"{what}s={len(values)}", allowed)
    tensor = values[0].type.tensor_type
    # Some exporters write -1 for "any".
    lengths = [
        dim.dim_value if dim.HasField("dim_value") and dim.dim_value != -1 else None
        for dim in tensor.shape.dim[: MAX_RANK + 1]
    ]
    is_batch = len(lengths) == 2 and lengths[0] is None and lengths[1] in widths
    if tensor.elem_type != _FLOAT or not is_batch:
        type_name = _TYPES.get(tensor.elem_type, (f"type {tensor.elem_type}",))[0]
        shape = ", ".join("any" if length is None else str(length) for length in lengths)
        name = values[0].name[:64]
        _refuse("onnx_interface", f"{what} {name!r}={type_name} [{shape}]", allowed)


def _limit(what: str, count: int, limit: int) -> None:
    if count > limit:
        _refuse("onnx_too_many_nodes", f"{what}={count:,}", f"must be at most {limit:,}")


def _refuse(code: str, field: str, allowed: str) -> NoReturn:
    raise Refused(code, f"{field}: {allowed}. {_REMEDIES[code]}.")


def _refuse_bytes(what: str) -> NoReturn:
    allowed = "must be one complete ONNX model, as `onnx.save` writes it"
    _refuse("onnx_malformed", f"policy: {what}", allowed)


def _refuse_type(field: str, value: int | None, where: str) -> NoReturn:
    names = ", ".join(name for name, *_ in _TYPES.values())
    _refuse("onnx_tensor", f"{field}={value} of {where}", f"must be one of {names}")
