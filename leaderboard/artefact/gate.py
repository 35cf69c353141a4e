"""`inspect`: what an ONNX file holds, from its bytes, before any runtime sees it.

A list of what is allowed; everything else is refused with a stable code (`errors.CODES`):

    ModelProto → GraphProto → NodeProto → AttributeProto → TensorProto
    one domain, one opset in 13 … 23, the operators of `OPERATORS`
    one float32 input [batch, S + 2], one float32 output [batch, A]
    tensors inside the file, dense, exactly as long as their dimensions say

A field that this file does not know is refused, and so is a second value of a field that has one:
readers differ in which one they keep. No memory or time grows with anything but the file's size
and `MAX_FIELDS`. What the operators of the list can still do (grow, take long, mix the rows of a
batch) is the sandbox's to find out.

Source: onnx.proto, the format's own definition. `S` state_dim, `A` action_dim.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import prod
from typing import Any, NamedTuple, NoReturn

from leaderboard.artefact.wire import (
    FIXED32,
    FIXED64,
    LENGTH,
    VARINT,
    Budget,
    BudgetError,
    WireError,
    fields,
    signed,
    varints,
)
from leaderboard.documents.submission import MAX_ARTEFACT_BYTES
from leaderboard.errors import Rejection

IR_VERSIONS = range(4, 14)  # before 4 every tensor had to be an input, too
OPSETS = range(13, 24)

MAX_NODES = 2048
MAX_TENSORS = 4096
MAX_ATTRIBUTES = 8192
MAX_FIELDS = 65_536
MAX_NAME = 256
MAX_RANK = 8

# What maps rows to rows with weights. Not here: randomness, loops and branches, sequences, text,
# and what makes arrays whose size is a number in the model, such as ConstantOfShape or Tile.
_NAMES = """
    Abs Acos Acosh Add And ArgMax ArgMin Asin Asinh Atan Atanh BatchNormalization Cast Ceil Celu
    Clip Concat Constant Cos Cosh Div Elu Equal Erf Exp Flatten Floor Gather GatherElements Gelu
    Gemm Greater GreaterOrEqual HardSigmoid HardSwish Identity LayerNormalization LeakyRelu Less
    LessOrEqual Log LogSoftmax MatMul Max Mean Min Mish Mod Mul Neg Not Or PRelu Pow
    RMSNormalization Reciprocal ReduceL1 ReduceL2 ReduceLogSumExp ReduceMax ReduceMean ReduceMin
    ReduceProd ReduceSum ReduceSumSquare Relu Reshape Round Selu Sigmoid Sign Sin Sinh Slice Softmax
    Softplus Softsign Split Sqrt Squeeze Sub Sum Tan Tanh ThresholdedRelu Transpose Unsqueeze Where
    Xor
"""
OPERATORS = frozenset(_NAMES.split())

_ONNX_DOMAINS = (b"", b"ai.onnx")
_FLOAT = 1


@dataclass(frozen=True)
class ModelFacts:
    """What a file that passed holds.

    Attributes:
      size: of the file, in bytes.
      ir_version, opset: of the format, and of its operators.
      nodes, tensors: how many.
      parameters: entries of all its tensors together.
      operators: the names of those used, sorted.
    """

    size: int
    ir_version: int
    opset: int
    nodes: int
    tensors: int
    parameters: int
    operators: tuple[str, ...]


def inspect(data: bytes, observation_dim: int, action_dim: int) -> ModelFacts:
    """Refuse a file that is anything but a feed-forward network of the right widths.

    Args:
      data: the file's bytes.
      observation_dim: S + 2, width of its input.
      action_dim: A, width of its output.

    Returns:
      What it holds.

    Raises:
      Rejection: `too_large`, `onnx_malformed`, `onnx_version`, `onnx_domain`, `onnx_op`,
        `onnx_subgraph`, `onnx_external_data`, `onnx_tensor`, `onnx_too_many_nodes` or
        `onnx_interface`.
    """
    if len(data) > MAX_ARTEFACT_BYTES:
        raise Rejection(
            "too_large",
            f"artefact={len(data):,} bytes: must be at most {MAX_ARTEFACT_BYTES:,}. "
            "Submit a smaller network.",
        )
    try:
        return _Inspection().model(memoryview(data), observation_dim, action_dim)
    except WireError as error:
        raise Rejection(
            "onnx_malformed",
            f"artefact: {error}: must be one whole ONNX model. "
            "Export it anew, and submit the file as it was written.",
        ) from None
    except BudgetError:
        raise Rejection(
            "onnx_too_many_nodes",
            f"artefact: more than {MAX_FIELDS:,} fields. Submit a smaller network, its tensors as "
            "raw data.",
        ) from None


class _Field(NamedTuple):
    """A known field of a message: its name, wire types, and whether it may be repeated."""

    name: str
    types: tuple[int, ...]
    many: bool = False


class _Refused(NamedTuple):
    """A field that must not be there: why."""

    name: str
    code: str
    remedy: str


_Schema = Mapping[int, _Field | _Refused]


def _bytes(name: str) -> _Field:
    """Text, bytes or a message."""
    return _Field(name, (LENGTH,))


def _list(name: str) -> _Field:
    """Many texts or messages."""
    return _Field(name, (LENGTH,), many=True)


def _int(name: str) -> _Field:
    return _Field(name, (VARINT,))


def _numbers(name: str, type: int) -> _Field:
    """Many numbers, packed or one by one."""
    return _Field(name, (type, LENGTH), many=True)


_NO_SUBGRAPH = "Export the network alone, its functions inlined"
_NO_SPARSE = "Store it as a dense tensor"
_PLAIN = "Export the network as plain operators with tensors inside the file"

_MODEL: _Schema = {
    1: _int("ir_version"),
    2: _bytes("producer_name"),
    3: _bytes("producer_version"),
    4: _bytes("domain"),
    5: _int("model_version"),
    6: _bytes("doc_string"),
    7: _bytes("graph"),
    8: _list("opset_import"),
    14: _list("metadata_props"),
    20: _Refused("training_info", "onnx_subgraph", _NO_SUBGRAPH),
    25: _Refused("functions", "onnx_subgraph", _NO_SUBGRAPH),
}
_OPSET: _Schema = {1: _bytes("domain"), 2: _int("version")}
_GRAPH: _Schema = {
    1: _list("node"),
    2: _bytes("name"),
    5: _list("initializer"),
    10: _bytes("doc_string"),
    11: _list("input"),
    12: _list("output"),
    13: _list("value_info"),
    14: _Refused("quantization_annotation", "onnx_tensor", _PLAIN),
    15: _Refused("sparse_initializer", "onnx_tensor", _NO_SPARSE),
    16: _list("metadata_props"),
}
_NODE: _Schema = {
    1: _list("input"),
    2: _list("output"),
    3: _bytes("name"),
    4: _bytes("op_type"),
    5: _list("attribute"),
    6: _bytes("doc_string"),
    7: _bytes("domain"),
    8: _Refused("overload", "onnx_subgraph", _NO_SUBGRAPH),
    9: _list("metadata_props"),
}
_ATTRIBUTE: _Schema = {
    1: _bytes("name"),
    2: _Field("f", (FIXED32,)),
    3: _int("i"),
    4: _bytes("s"),
    5: _bytes("t"),
    6: _Refused("g", "onnx_subgraph", _NO_SUBGRAPH),
    7: _numbers("floats", FIXED32),
    8: _numbers("ints", VARINT),
    9: _list("strings"),
    10: _Refused("tensors", "onnx_tensor", _PLAIN),
    11: _Refused("graphs", "onnx_subgraph", _NO_SUBGRAPH),
    13: _bytes("doc_string"),
    14: _Refused("tp", "onnx_tensor", _PLAIN),
    15: _Refused("type_protos", "onnx_tensor", _PLAIN),
    20: _int("type"),
    21: _Refused("ref_attr_name", "onnx_subgraph", _NO_SUBGRAPH),
    22: _Refused("sparse_tensor", "onnx_tensor", _NO_SPARSE),
    23: _Refused("sparse_tensors", "onnx_tensor", _NO_SPARSE),
}
# The field that holds an attribute's value, by the attribute's type.
_ATTRIBUTE_VALUES = {1: "f", 2: "i", 3: "s", 4: "t", 6: "floats", 7: "ints", 8: "strings"}
_TENSOR: _Schema = {
    1: _numbers("dims", VARINT),
    2: _int("data_type"),
    3: _Refused("segment", "onnx_tensor", _PLAIN),
    4: _numbers("float_data", FIXED32),
    5: _numbers("int32_data", VARINT),
    6: _Refused("string_data", "onnx_tensor", _PLAIN),
    7: _numbers("int64_data", VARINT),
    8: _bytes("name"),
    9: _bytes("raw_data"),
    10: _numbers("double_data", FIXED64),
    11: _Refused("uint64_data", "onnx_tensor", _PLAIN),
    12: _bytes("doc_string"),
    13: _Refused("external_data", "onnx_external_data", "Export with external_data=False"),
    14: _int("data_location"),
    16: _list("metadata_props"),
}


class _Type(NamedTuple):
    """A type of tensors: its name, bytes of an entry, and the field of its data if not raw."""

    name: str
    size: int
    field: str


_TYPES = {
    1: _Type("float32", 4, "float_data"),
    6: _Type("int32", 4, "int32_data"),
    7: _Type("int64", 8, "int64_data"),
    9: _Type("bool", 1, "int32_data"),
    11: _Type("float64", 8, "double_data"),
}
_DATA = ("raw_data", *dict.fromkeys(type.field for type in _TYPES.values()))
_TYPE_NAMES = ", ".join(type.name for type in _TYPES.values())

_VALUE_INFO: _Schema = {
    1: _bytes("name"),
    2: _bytes("type"),
    3: _bytes("doc_string"),
    4: _list("metadata_props"),
}
_VALUE_TYPE: _Schema = {
    1: _bytes("tensor_type"),
    6: _bytes("denotation"),
    **{
        number: _Refused(name, "onnx_interface", "Export the network with plain tensors")
        for number, name in {
            4: "sequence_type",
            5: "map_type",
            7: "opaque_type",
            8: "sparse_tensor_type",
            9: "optional_type",
        }.items()
    },
}
_TENSOR_TYPE: _Schema = {1: _int("elem_type"), 2: _bytes("shape")}
_SHAPE: _Schema = {1: _list("dim")}
_DIMENSION: _Schema = {1: _int("dim_value"), 2: _bytes("dim_param"), 3: _bytes("denotation")}


class _Inspection:
    """One file's walk: each method reads one kind of message, and refuses what is wrong in it."""

    def __init__(self) -> None:
        self._budget = Budget(MAX_FIELDS)
        self._attributes = 0
        self._tensors = 0
        self._parameters = 0
        self._operators: set[str] = set()

    def model(self, data: memoryview, observation_dim: int, action_dim: int) -> ModelFacts:
        model = self._read(data, _MODEL, "model")
        ir_version = model.get("ir_version", 0)
        if ir_version not in IR_VERSIONS:
            _refuse(
                "onnx_version",
                f"ir_version={ir_version}",
                f"must be in [{IR_VERSIONS[0]}, {IR_VERSIONS[-1]}]",
                "Export it with an opset from 13 to 23 and the IR version that goes with it",
            )
        opset = self._opset(model["opset_import"])
        if "graph" not in model:
            raise WireError("it holds no graph")
        graph = self._read(model["graph"], _GRAPH, "graph")
        self._limit("nodes", len(graph["node"]), MAX_NODES)
        self._limit("tensors", len(graph["initializer"]), MAX_TENSORS)
        for node in graph["node"]:
            self._node(node)
        for tensor in graph["initializer"]:
            self._tensor(tensor)
        for value in graph["value_info"]:
            self._value(value)
        self._interface("input", graph["input"], observation_dim, exact=True)
        self._interface("output", graph["output"], action_dim, exact=False)
        return ModelFacts(
            size=len(data),
            ir_version=ir_version,
            opset=opset,
            nodes=len(graph["node"]),
            tensors=self._tensors,
            parameters=self._parameters,
            operators=tuple(sorted(self._operators)),
        )

    def _opset(self, imports: list[memoryview]) -> int:
        found = [self._read(each, _OPSET, "opset_import") for each in imports]
        domains = [bytes(each.get("domain", b"")) for each in found]
        if len(found) != 1 or domains[0] not in _ONNX_DOMAINS:
            _refuse(
                "onnx_domain",
                f"opset_import={[_text(domain) for domain in domains[:4]]}",
                "must be ONNX's own domain, '', once and nothing else",
                "Export the network to standard operators only",
            )
        version = int(found[0].get("version", 0))
        if version not in OPSETS:
            _refuse(
                "onnx_version",
                f"opset={version}",
                f"must be in [{OPSETS[0]}, {OPSETS[-1]}]",
                "Export it with opset_version=17",
            )
        return version

    def _node(self, message: memoryview) -> None:
        node = self._read(message, _NODE, "node")
        domain, operator = bytes(node.get("domain", b"")), _text(node.get("op_type", b""))
        if domain not in _ONNX_DOMAINS:
            _refuse(
                "onnx_domain",
                f"domain={_text(domain)!r} of operator {operator!r}",
                "must be ONNX's own, ''",
                "Export the network to standard operators only",
            )
        if operator not in OPERATORS:
            _refuse(
                "onnx_op",
                f"op_type={operator!r}",
                "must be an operator of a feed-forward network (`gate.OPERATORS`)",
                "Export the deterministic actor alone, or rewrite it with those operators",
            )
        self._operators.add(operator)
        self._names("node", node.get("name", b""), *node["input"], *node["output"])
        self._attributes += len(node["attribute"])
        self._limit("attributes", self._attributes, MAX_ATTRIBUTES)
        for attribute in node["attribute"]:
            self._attribute(attribute, operator)

    def _attribute(self, message: memoryview, operator: str) -> None:
        attribute = self._read(message, _ATTRIBUTE, "attribute")
        name = _text(attribute.get("name", b""))
        self._names("attribute", attribute.get("name", b""), *attribute["strings"])
        held = {
            field for field in _ATTRIBUTE_VALUES.values() if attribute.get(field) not in (None, [])
        }
        expected = _ATTRIBUTE_VALUES.get(attribute.get("type", 0))
        # An empty list has no field at all; a single value always has one.
        if expected is None or not held <= {expected} or not (held or expected.endswith("s")):
            raise WireError(f"attribute {name!r} of {operator} does not hold what its type says")
        if expected == "t":
            self._limit("tensors", self._tensors + 1, MAX_TENSORS)
            self._tensor(attribute["t"])
        if operator == "Cast" and name == "to" and attribute.get("i") not in _TYPES:
            _refuse_type("to", attribute.get("i"), "Cast")

    def _tensor(self, message: memoryview) -> None:
        tensor = self._read(message, _TENSOR, "tensor")
        name = _text(tensor.get("name", b""))
        self._names("tensor", tensor.get("name", b""))
        if tensor.get("data_location", 0) != 0:
            _refuse(
                "onnx_external_data",
                f"data_location={tensor['data_location']} of tensor {name!r}",
                "must be inside the file",
                "Export with external_data=False",
            )
        type = _TYPES.get(tensor.get("data_type", 0))
        if type is None:
            _refuse_type("data_type", tensor.get("data_type", 0), f"tensor {name!r}")
        dims = [signed(dim) for dim in self._integers(tensor["dims"])]
        # Ones in place of zeros: no product of dimensions overflows in anyone's arithmetic.
        if (
            len(dims) > MAX_RANK
            or any(dim < 0 for dim in dims)
            or prod(max(dim, 1) for dim in dims) > MAX_ARTEFACT_BYTES
        ):
            _refuse(
                "onnx_tensor",
                f"dims={dims[: MAX_RANK + 1]} of tensor {name!r}",
                f"must be at most {MAX_RANK} lengths, none negative, of a tensor that fits into "
                f"{MAX_ARTEFACT_BYTES:,} bytes",
                "Submit a smaller network",
            )
        entries = prod(dims)
        found = self._entries(tensor, type, name)
        if found != entries:
            _refuse(
                "onnx_tensor",
                f"dims={dims} of tensor {name!r}",
                f"is {entries:,} entries, and its data are {found:,}",
                "Export it anew",
            )
        self._tensors += 1
        self._parameters += entries

    def _entries(self, tensor: dict[str, Any], type: _Type, name: str) -> int:
        """How many entries a tensor's data are; a broken one counts as none."""
        held = [field for field in _DATA if tensor.get(field) not in (None, [])]
        if not set(held) <= {"raw_data", type.field} or len(held) > 1:
            _refuse(
                "onnx_tensor",
                f"{', '.join(held)} of tensor {name!r}",
                f"must be raw_data or {type.field}, one of them, for {type.name}",
                "Export it anew",
            )
        if not held:
            return 0
        if held == ["raw_data"]:
            size, rest = divmod(len(tensor["raw_data"]), type.size)
        elif type.field in ("int32_data", "int64_data"):
            size, rest = sum(1 for _ in self._integers(tensor[type.field])), 0
        else:
            size, rest = divmod(sum(map(len, tensor[type.field])), type.size)
        if rest:
            raise WireError(f"data of tensor {name!r} end in the middle of an entry")
        return size

    def _value(self, message: memoryview) -> tuple[str, int, list[int | None]] | None:
        """Name, element type and shape of a value, None where a length is open; None if untyped."""
        value = self._read(message, _VALUE_INFO, "value")
        self._names("value", value.get("name", b""))
        type = self._read(value.get("type", memoryview(b"")), _VALUE_TYPE, "type")
        if "tensor_type" not in type:
            return None
        tensor = self._read(type["tensor_type"], _TENSOR_TYPE, "tensor_type")
        shape = self._read(tensor.get("shape", memoryview(b"")), _SHAPE, "shape")
        self._limit("dimensions", len(shape["dim"]), MAX_RANK)
        lengths: list[int | None] = []
        for each in shape["dim"]:
            dim = self._read(each, _DIMENSION, "dim")
            if "dim_value" in dim and "dim_param" in dim:
                raise WireError("a dimension has both a length and a symbol")
            length = signed(dim["dim_value"]) if "dim_value" in dim else None
            lengths.append(None if length == -1 else length)  # as some exporters say "any"
        return _text(value.get("name", b"")), tensor.get("elem_type", 0), lengths

    def _interface(self, what: str, values: list[memoryview], width: int, exact: bool) -> None:
        """One float32 `[batch, width]`; an output's width may be left open, the run will tell."""
        remedy = f"Export the actor with one {what}, its batch a dynamic axis, for this task"
        allowed = f"must be one float32 {what} [batch, {width}]"
        if len(values) != 1:
            _refuse("onnx_interface", f"{what}s={len(values)}", allowed, remedy)
        found = self._value(values[0])
        if found is None:
            _refuse("onnx_interface", f"{what} is no tensor", allowed, remedy)
        name, type, shape = found
        widths = (width,) if exact else (width, None)
        if type != _FLOAT or len(shape) != 2 or shape[0] is not None or shape[1] not in widths:
            told = _TYPES[type].name if type in _TYPES else f"type {type}"
            lengths = ", ".join("any" if length is None else str(length) for length in shape)
            _refuse("onnx_interface", f"{what} {name!r}={told} [{lengths}]", allowed, remedy)

    def _read(self, message: memoryview, schema: _Schema, where: str) -> dict[str, Any]:
        """A message's fields by name: a list where a field may be repeated, absent where absent."""
        read: dict[str, Any] = {
            field.name: [] for field in schema.values() if isinstance(field, _Field) and field.many
        }
        for number, type, value in fields(message, self._budget):
            field = schema.get(number)
            if isinstance(field, _Refused):
                _refuse(field.code, f"{where}.{field.name}", "must not be there", field.remedy)
            if field is None or type not in field.types:
                raise WireError(f"unknown field {number} of wire type {type} in a {where}")
            if field.many:
                read[field.name].append(value)
            elif field.name in read:
                raise WireError(f"two values of {where}.{field.name}")
            else:
                read[field.name] = value
        return read

    def _integers(self, values: list[int | memoryview]) -> Iterable[int]:
        """Repeated integers, whether packed or one by one."""
        for value in values:
            if isinstance(value, int):
                yield value
            else:
                yield from varints(value, self._budget)

    def _names(self, where: str, *names: bytes | memoryview) -> None:
        longest = max(map(len, names))
        if longest > MAX_NAME:
            _refuse(
                "onnx_too_many_nodes",
                f"a name of {longest:,} bytes in a {where}",
                f"must be at most {MAX_NAME} bytes",
                "Shorten it",
            )

    def _limit(self, what: str, count: int, limit: int) -> None:
        if count > limit:
            _refuse(
                "onnx_too_many_nodes",
                f"{what}={count:,}",
                f"must be at most {limit:,}",
                "Submit a smaller network",
            )


def _refuse(code: str, found: str, allowed: str, remedy: str) -> NoReturn:
    raise Rejection(code, f"{found}: {allowed}. {remedy}.")


def _refuse_type(field: str, value: int | None, where: str) -> NoReturn:
    _refuse(
        "onnx_tensor",
        f"{field}={value} of {where}",
        f"must be one of {_TYPE_NAMES}",
        "Export the network in float32",
    )


def _text(name: bytes | memoryview) -> str:
    """A name as messages show it: short, and nothing that moves a cursor."""
    text = bytes(name[:64]).decode("utf-8", "replace")
    return "".join(letter if letter.isprintable() else "�" for letter in text)
