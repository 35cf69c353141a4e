"""The fields of ONNX's messages that the gate allows, and those that it rejects by name.

Source: onnx.proto, the definition of the format.
"""

from __future__ import annotations

from typing import NamedTuple

from leaderboard.artefact.wire import FIXED32, FIXED64, LENGTH, VARINT


class Field(NamedTuple):
    """A known field: name, allowed wire types, and whether it may repeat."""

    name: str
    types: tuple[int, ...]
    many: bool = False


class Rejected(NamedTuple):
    """A field that is not allowed: the code, and what to do."""

    name: str
    code: str
    remedy: str


Schema = dict[int, Field | Rejected]


def _one(type: int, names: dict[int, str]) -> Schema:
    """Fields with one value: a number, or (`LENGTH`) text, bytes or a message."""
    return {number: Field(name, (type,)) for number, name in names.items()}


def _many(type: int, names: dict[int, str]) -> Schema:
    """Fields that may repeat; numbers may also be packed."""
    types = (type,) if type == LENGTH else (type, LENGTH)
    return {number: Field(name, types, many=True) for number, name in names.items()}


def _rejected(reason: tuple[str, str], names: dict[int, str]) -> Schema:
    """Fields that are not allowed: code and remedy."""
    return {number: Rejected(name, *reason) for number, name in names.items()}


_SUBGRAPH = "onnx_subgraph", "Export the network alone, its functions inlined"
_SPARSE = "onnx_tensor", "Store it as a dense tensor"
_NOT_PLAIN = "onnx_tensor", "Export the network as plain operators with tensors inside the file"
_NO_TENSOR = "onnx_interface", "Export the network with plain tensors"
_EXTERNAL = "onnx_external_data", "Export with external_data=False"

MODEL = {
    **_one(VARINT, {1: "ir_version", 5: "model_version"}),
    **_one(LENGTH, {2: "producer_name", 3: "producer_version", 4: "domain", 6: "doc_string"}),
    **_one(LENGTH, {7: "graph"}),
    **_many(LENGTH, {8: "opset_import", 14: "metadata_props"}),
    **_rejected(_SUBGRAPH, {20: "training_info", 25: "functions"}),
}
OPSET = {**_one(LENGTH, {1: "domain"}), **_one(VARINT, {2: "version"})}
GRAPH = {
    **_one(LENGTH, {2: "name", 10: "doc_string"}),
    **_many(LENGTH, {1: "node", 5: "initializer", 11: "input", 12: "output", 13: "value_info"}),
    **_many(LENGTH, {16: "metadata_props"}),
    **_rejected(_NOT_PLAIN, {14: "quantization_annotation"}),
    **_rejected(_SPARSE, {15: "sparse_initializer"}),
}
NODE = {
    **_one(LENGTH, {3: "name", 4: "op_type", 6: "doc_string", 7: "domain"}),
    **_many(LENGTH, {1: "input", 2: "output", 5: "attribute", 9: "metadata_props"}),
    **_rejected(_SUBGRAPH, {8: "overload"}),
}
ATTRIBUTE = {
    **_one(LENGTH, {1: "name", 4: "s", 5: "t", 13: "doc_string"}),
    **_one(FIXED32, {2: "f"}),
    **_one(VARINT, {3: "i", 20: "type"}),
    **_many(FIXED32, {7: "floats"}),
    **_many(VARINT, {8: "ints"}),
    **_many(LENGTH, {9: "strings"}),
    **_rejected(_SUBGRAPH, {6: "g", 11: "graphs", 21: "ref_attr_name"}),
    **_rejected(_NOT_PLAIN, {10: "tensors", 14: "tp", 15: "type_protos"}),
    **_rejected(_SPARSE, {22: "sparse_tensor", 23: "sparse_tensors"}),
}
TENSOR = {
    **_one(VARINT, {2: "data_type", 14: "data_location"}),
    **_one(LENGTH, {8: "name", 9: "raw_data", 12: "doc_string"}),
    **_many(VARINT, {1: "dims", 5: "int32_data", 7: "int64_data"}),
    **_many(FIXED32, {4: "float_data"}),
    **_many(FIXED64, {10: "double_data"}),
    **_many(LENGTH, {16: "metadata_props"}),
    **_rejected(_NOT_PLAIN, {3: "segment", 6: "string_data", 11: "uint64_data"}),
    **_rejected(_EXTERNAL, {13: "external_data"}),
}
VALUE_INFO = {
    **_one(LENGTH, {1: "name", 2: "type", 3: "doc_string"}),
    **_many(LENGTH, {4: "metadata_props"}),
}
VALUE_TYPE = {
    **_one(LENGTH, {1: "tensor_type", 6: "denotation"}),
    **_rejected(_NO_TENSOR, {4: "sequence_type", 5: "map_type", 7: "opaque_type"}),
    **_rejected(_NO_TENSOR, {8: "sparse_tensor_type", 9: "optional_type"}),
}
TENSOR_TYPE = {**_one(VARINT, {1: "elem_type"}), **_one(LENGTH, {2: "shape"})}
SHAPE = _many(LENGTH, {1: "dim"})
DIMENSION = {**_one(VARINT, {1: "dim_value"}), **_one(LENGTH, {2: "dim_param", 3: "denotation"})}

# The field with an attribute's value, by the attribute's type.
ATTRIBUTE_VALUES = {1: "f", 2: "i", 3: "s", 4: "t", 6: "floats", 7: "ints", 8: "strings"}


class Type(NamedTuple):
    """A type of tensors: its name, the bytes of an entry, and the field of data that is not raw."""

    name: str
    size: int
    field: str


TYPES = {
    1: Type("float32", 4, "float_data"),
    6: Type("int32", 4, "int32_data"),
    7: Type("int64", 8, "int64_data"),
    9: Type("bool", 1, "int32_data"),
    11: Type("float64", 8, "double_data"),
}
DATA = ("raw_data", *dict.fromkeys(type.field for type in TYPES.values()))
