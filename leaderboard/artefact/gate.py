"""`inspect`: check the bytes of an ONNX file before any runtime reads them.

An allow-list; everything else is rejected with a stable code (`errors.CODES`):

    ModelProto → GraphProto → NodeProto → AttributeProto → TensorProto
    one domain, one opset in 13 … 23, the operators of `sme_registry.export.FEED_FORWARD`
    one float32 input [batch, S + 2], one float32 output [batch, A]; for teams see `widths`
    dense tensors inside the file, whose data match their dimensions

Unknown fields are rejected, and so is a second value of a field that has one, because readers
differ in which value they keep. Google's parser accepts both, and for 8 MiB of crafted bytes takes
up to 650 MiB of memory. Here memory and time grow only with the file's size and `MAX_FIELDS`, so
that a server may call it in its own process. What the listed operators can still do (grow, run
long, mix the rows of a batch) the sandbox detects.

Source: onnx.proto, the definition of the format. `S` state_dim, `A` action_dim.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import prod
from typing import Any, NoReturn

from leaderboard.artefact import schema
from leaderboard.artefact.wire import Budget, BudgetError, WireError, fields, signed, varints
from leaderboard.documents.submission import MAX_ARTEFACT_BYTES
from leaderboard.errors import Rejection
from sme_registry import SMESpec
from sme_registry.evaluation import interface_of
from sme_registry.export import FEED_FORWARD

IR_VERSIONS = range(4, 14)  # before 4 every tensor had to be an input, too
OPSETS = range(13, 24)

MAX_NODES = 2048
MAX_TENSORS = 4096
MAX_ATTRIBUTES = 8192
MAX_FIELDS = 65_536
MAX_NAME = 256
MAX_RANK = 8

# The first input of each operator that the format allows to be left out, with an empty name.
_OPTIONAL_INPUTS = {
    "Clip": 1,
    "Gemm": 2,
    "LayerNormalization": 2,
    "Slice": 3,
    "Split": 1,
    "Squeeze": 1,
    **{name: 1 for name in FEED_FORWARD if name.startswith("Reduce")},
}

_ONNX_DOMAINS = (b"", b"ai.onnx")
_STANDARD = "Export the network to standard operators only"
_FLOAT = 1


def widths(spec: SMESpec) -> tuple[int, int]:
    """The widths of a task's policies, of observations and of actions.

    A team has one policy, which is called for each agent with that agent's shared observation: the
    scorer computes it, so no agent sees more of the state than it observes.
    """
    interface = interface_of(spec)
    return interface.observation_dim, interface.action_dim


def inspect(data: bytes, observation_dim: int, action_dim: int) -> None:
    """Reject a file that is not a feed-forward network of the right widths.

    Args:
      data: the bytes of the file.
      observation_dim: the width of its input; S + 2 for a single agent.
      action_dim: the width of its output; A for a single agent.

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
        _Inspection().model(memoryview(data), observation_dim, action_dim)
    except WireError as error:
        raise Rejection(
            "onnx_malformed",
            f"artefact: {error}: must be one complete ONNX model. "
            "Export it again, and submit the file unchanged.",
        ) from None
    except BudgetError:
        raise Rejection(
            "onnx_too_many_nodes",
            f"artefact: more than {MAX_FIELDS:,} fields. Submit a smaller network, its "
            "tensors as raw data.",
        ) from None


class _Inspection:
    """The inspection of one file: each method reads and checks one kind of message."""

    def __init__(self) -> None:
        self._budget = Budget(MAX_FIELDS)
        self._attributes = 0
        self._tensors = 0
        self._opset_version = 0
        self._values: set[bytes] = set()

    def model(self, data: memoryview, observation_dim: int, action_dim: int) -> None:
        model = self._read(data, schema.MODEL, "model")
        ir_version = model.get("ir_version", 0)
        if ir_version not in IR_VERSIONS:
            _refuse(
                "onnx_version",
                f"ir_version={ir_version}",
                f"must be in [{IR_VERSIONS[0]}, {IR_VERSIONS[-1]}]",
                "Export it with an opset from 13 to 23 and the matching IR version",
            )
        self._opset_version = self._opset(model["opset_import"])
        if "graph" not in model:
            raise WireError("no graph")
        graph = self._read(model["graph"], schema.GRAPH, "graph")
        self._limit("nodes", len(graph["node"]), MAX_NODES)
        self._limit("tensors", len(graph["initializer"]), MAX_TENSORS)
        for node in graph["node"]:
            self._node(node)
        for tensor in graph["initializer"]:
            self._define(self._tensor(tensor))
        for value in graph["value_info"]:
            self._value(value)
        self._define(self._interface("input", graph["input"], observation_dim, exact=True))
        self._interface("output", graph["output"], action_dim, exact=False)

    def _opset(self, imports: list[memoryview]) -> int:
        opsets = [self._read(each, schema.OPSET, "opset_import") for each in imports]
        domains = [bytes(each.get("domain", b"")) for each in opsets]
        if len(opsets) != 1 or domains[0] not in _ONNX_DOMAINS:
            _refuse(
                "onnx_domain",
                f"opset_import={[_text(domain) for domain in domains[:4]]}",
                "must be ONNX's own domain, '', once",
                _STANDARD,
            )
        version = int(opsets[0].get("version", 0))
        if version not in OPSETS:
            _refuse(
                "onnx_version",
                f"opset={version}",
                f"must be in [{OPSETS[0]}, {OPSETS[-1]}]",
                "Export it with opset_version=17",
            )
        return version

    def _node(self, message: memoryview) -> None:
        node = self._read(message, schema.NODE, "node")
        domain, operator = bytes(node.get("domain", b"")), _text(node.get("op_type", b""))
        if domain not in _ONNX_DOMAINS:
            _refuse(
                "onnx_domain",
                f"domain={_text(domain)!r} of operator {operator!r}",
                "must be ONNX's own, ''",
                _STANDARD,
            )
        if operator not in FEED_FORWARD:
            _refuse(
                "onnx_op",
                f"op_type={operator!r}",
                "must be an operator of a feed-forward network (see docs/tutorials/own_agents.md)",
                "Export the deterministic actor alone with `sme_registry.export_onnx`, which "
                "removes what it can and says how to rewrite the rest",
            )
        self._names("node", node.get("name", b""), *node["input"], *node["output"])
        self._values_of(node, operator)
        self._attributes += len(node["attribute"])
        self._limit("attributes", self._attributes, MAX_ATTRIBUTES)
        attributes = dict(self._attribute(each, operator) for each in node["attribute"])
        if len(attributes) < len(node["attribute"]):
            raise WireError(f"two attributes of one name in {operator}")
        if operator == "Split":
            self._split(node, attributes.get(b"num_outputs"))

    def _split(self, node: dict[str, Any], announced: int | None) -> None:
        """Require that a Split says how many outputs it has, which onnxruntime does not check."""
        outputs, has_lengths = len(node["output"]), node["input"][1:] not in ([], [b""])
        # Before opset 18 the attribute does not exist, and onnxruntime counts the outputs.
        if (announced is not None and announced != outputs) or (
            announced is None and not has_lengths and self._opset_version >= 18
        ):
            raise WireError(f"Split with {outputs} outputs and num_outputs={announced}")

    def _values_of(self, node: dict[str, Any], operator: str) -> None:
        """Require a name for each value that is not optional, and one source of each value.

        onnxruntime crashes at some of the others.
        """
        required = node["input"][: _OPTIONAL_INPUTS.get(operator)]
        if b"" in required or not node["output"]:
            raise WireError(f"{operator} without a name of an input or output")
        for name in node["output"]:
            self._define(bytes(name))

    def _define(self, name: bytes) -> None:
        if name == b"" or name in self._values:
            raise WireError(f"a value {_text(name)!r} that has no name or two sources")
        self._values.add(name)

    def _attribute(self, message: memoryview, operator: str) -> tuple[bytes, int | None]:
        """Check an attribute; return its name and, if it has one, its integer."""
        attribute = self._read(message, schema.ATTRIBUTE, "attribute")
        name = _text(attribute.get("name", b""))
        self._names("attribute", attribute.get("name", b""), *attribute["strings"])
        held = {
            field
            for field in schema.ATTRIBUTE_VALUES.values()
            if attribute.get(field) not in (None, [])
        }
        expected = schema.ATTRIBUTE_VALUES.get(attribute.get("type", 0))
        # An empty list has no field; a single value always has one.
        if expected is None or not held <= {expected} or not (held or expected.endswith("s")):
            raise WireError(f"attribute {name!r} of {operator} has a value of another type")
        if expected == "t":
            self._limit("tensors", self._tensors + 1, MAX_TENSORS)
            self._tensor(attribute["t"])
        if operator == "Cast" and name == "to" and attribute.get("i") not in schema.TYPES:
            _refuse_type("to", attribute.get("i"), "Cast")
        return bytes(attribute.get("name", b"")), attribute.get("i")

    def _tensor(self, message: memoryview) -> bytes:
        """Check a tensor; return its name."""
        tensor = self._read(message, schema.TENSOR, "tensor")
        name = _text(tensor.get("name", b""))
        self._names("tensor", tensor.get("name", b""))
        if tensor.get("data_location", 0) != 0:
            _refuse(
                "onnx_external_data",
                f"data_location={tensor['data_location']} of tensor {name!r}",
                "must be inside the file",
                "Export with external_data=False",
            )
        type = schema.TYPES.get(tensor.get("data_type", 0))
        if type is None:
            _refuse_type("data_type", tensor.get("data_type", 0), f"tensor {name!r}")
        dims = [signed(dim) for dim in self._integers(tensor["dims"])]
        # Zeros count as ones, so that no reader's product of dimensions overflows.
        if (
            len(dims) > MAX_RANK
            or any(dim < 0 for dim in dims)
            or prod(max(dim, 1) for dim in dims) > MAX_ARTEFACT_BYTES
        ):
            _refuse(
                "onnx_tensor",
                f"dims={dims[: MAX_RANK + 1]} of tensor {name!r}",
                f"must be at most {MAX_RANK} non-negative lengths of a tensor that fits into "
                f"{MAX_ARTEFACT_BYTES:,} bytes",
                "Submit a smaller network",
            )
        entries = prod(dims)
        stored = self._entries(tensor, type, name)
        if stored != entries:
            _refuse(
                "onnx_tensor",
                f"dims={dims} of tensor {name!r}",
                f"must match its data: {entries:,} entries, not {stored:,}",
                "Export it again",
            )
        self._tensors += 1
        return bytes(tensor.get("name", b""))

    def _entries(self, tensor: dict[str, Any], type: schema.Type, name: str) -> int:
        """Number of entries in a tensor's data."""
        held = [field for field in schema.DATA if tensor.get(field) not in (None, [])]
        if not set(held) <= {"raw_data", type.field} or len(held) > 1:
            _refuse(
                "onnx_tensor",
                f"{', '.join(held)} of tensor {name!r}",
                f"must be either raw_data or {type.field} for {type.name}",
                "Export it again",
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
            raise WireError(f"the data of tensor {name!r} end within an entry")
        return size

    def _value(self, message: memoryview) -> tuple[bytes, int, list[int | None]] | None:
        """Name, element type and shape (open lengths are None) of a value; None if untyped."""
        value = self._read(message, schema.VALUE_INFO, "value")
        self._names("value", value.get("name", b""))
        type = self._read(value.get("type", memoryview(b"")), schema.VALUE_TYPE, "type")
        if "tensor_type" not in type:
            return None
        tensor = self._read(type["tensor_type"], schema.TENSOR_TYPE, "tensor_type")
        shape = self._read(tensor.get("shape", memoryview(b"")), schema.SHAPE, "shape")
        self._limit("dimensions", len(shape["dim"]), MAX_RANK)
        lengths: list[int | None] = []
        for each in shape["dim"]:
            dim = self._read(each, schema.DIMENSION, "dim")
            if "dim_value" in dim and "dim_param" in dim:
                raise WireError("a dimension with a length and a symbol")
            length = signed(dim["dim_value"]) if "dim_value" in dim else None
            lengths.append(None if length == -1 else length)  # some exporters write -1 for "any"
        return bytes(value.get("name", b"")), tensor.get("elem_type", 0), lengths

    def _interface(self, what: str, values: list[memoryview], width: int, exact: bool) -> bytes:
        """Require one float32 `[batch, width]`; unless `exact`, the width may be open.

        It returns the name.
        """
        remedy = f"Export the actor with one {what}, its batch a dynamic axis, for this task"
        allowed = f"must be one float32 {what} [batch, {width}]"
        if len(values) != 1:
            _refuse("onnx_interface", f"{what}s={len(values)}", allowed, remedy)
        value = self._value(values[0])
        if value is None:
            _refuse("onnx_interface", f"{what} without a tensor type", allowed, remedy)
        name, type, shape = value
        widths = (width,) if exact else (width, None)
        if type != _FLOAT or len(shape) != 2 or shape[0] is not None or shape[1] not in widths:
            type_name = schema.TYPES[type].name if type in schema.TYPES else f"type {type}"
            lengths = ", ".join("any" if length is None else str(length) for length in shape)
            _refuse(
                "onnx_interface", f"{what} {_text(name)!r}={type_name} [{lengths}]", allowed, remedy
            )
        return name

    def _read(self, message: memoryview, known: schema.Schema, where: str) -> dict[str, Any]:
        """The fields of a message by name; a list if they may repeat, else absent if missing."""
        read: dict[str, Any] = {
            field.name: []
            for field in known.values()
            if isinstance(field, schema.Field) and field.many
        }
        for number, type, value in fields(message, self._budget):
            field = known.get(number)
            if isinstance(field, schema.Rejected):
                _refuse(field.code, f"{where}.{field.name}", "not allowed", field.remedy)
            if field is None or type not in field.types:
                raise WireError(f"unknown field {number} of wire type {type} in {where}")
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
        what = f"bytes of a name in a {where}"
        self._limit(what, max(map(len, names)), MAX_NAME, "Shorten it")

    def _limit(
        self, what: str, count: int, limit: int, remedy: str = "Submit a smaller network"
    ) -> None:
        if count > limit:
            allowed = f"must be at most {limit:,}"
            _refuse("onnx_too_many_nodes", f"{what}={count:,}", allowed, remedy)


def _refuse(code: str, field: str, allowed: str, remedy: str) -> NoReturn:
    raise Rejection(code, f"{field}: {allowed}. {remedy}.")


def _refuse_type(field: str, value: int | None, where: str) -> NoReturn:
    _refuse(
        "onnx_tensor",
        f"{field}={value} of {where}",
        f"must be one of {', '.join(type.name for type in schema.TYPES.values())}",
        "Export the network in float32",
    )


def printable(text: bytes | bytearray | memoryview) -> str:
    """Untrusted text as messages show it, without control characters."""
    letters = bytes(text).decode("utf-8", "replace")
    return "".join(letter if letter.isprintable() else "�" for letter in letters)


def _text(name: bytes | memoryview) -> str:
    """A name as messages show it: short and printable."""
    return printable(name[:64])
