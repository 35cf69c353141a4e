"""The base of every document: frozen, strict, hashed by its canonical JSON.

digest = "sha256:" + hex(SHA-256(RFC 8785 canonical JSON of all fields)), so equal documents have
equal digests on every machine, regardless of key order and of how a number was written.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Protocol, Self

import rfc8785
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails

from sme_registry.errors import SpecError, did_you_mean

_MAX_REPR = 60


def plain_number(value: Any) -> Any:
    """NumPy's numbers as Python's, so that a sweep over `np.arange` needs no casts.

    Negative zero becomes zero: the two are equal, so they must not differ in text. Booleans and
    everything else stay as they are.
    """
    if type(value).__module__ == "numpy" and getattr(value, "ndim", None) == 0:
        kind = value.dtype.kind
        if kind in "iuf":
            value = value.item()
    return value + 0.0 if type(value) is float else value


def _integer_only(value: Any) -> Any:
    """Reject what Python calls equal to an integer: `Literal[1]` takes True and 1.0 for 1."""
    number = plain_number(value)
    if type(number) is not int:
        raise ValueError("must be 1. Leave it out for the default, 1.")
    return number


Integer = int
Real = Annotated[float, Field(allow_inf_nan=False)]
SchemaVersion = Annotated[Literal[1], BeforeValidator(_integer_only)]
Name = Annotated[
    str,
    Field(
        pattern=r"^[A-Za-z0-9_-]+$",
        min_length=1,
        max_length=64,
        description="a string of 1 to 64 letters, digits, '_' and '-'",
    ),
]
Digest = Annotated[
    str,
    Field(pattern=r"^sha256:[0-9a-f]{64}$", description="'sha256:' and 64 lower-case hex digits"),
]


class StrictModel(BaseModel):
    """Frozen and strict; invalid and unknown fields are errors that say how to correct them."""

    # An instance of a subclass has more fields than its place: equal digests, unequal documents.
    model_config = ConfigDict(
        frozen=True,
        strict=True,
        extra="forbid",
        validate_default=False,
        revalidate_instances="subclass-instances",
    )

    def __init__(self, **data: Any) -> None:
        try:
            super().__init__(**data)
        except ValidationError as error:
            raise _spec_error(type(self), error, "") from None

    # The mark of Pydantic's own constructors: without it, each nested model would be validated by
    # this one, and raise an error without the path that leads to it.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @model_validator(mode="before")
    @classmethod
    def _plain_numbers(cls, data: Any) -> Any:
        """`plain_number` of every value, and of the entries of lists.

        Not validators of the fields' types: Pydantic's JSON Schema loses the bounds of a number
        that has a validator of its own.
        """
        if not isinstance(data, dict):
            return data
        return {
            name: [plain_number(entry) for entry in value]
            if type(value) in (list, tuple)
            else plain_number(value)
            for name, value in data.items()
        }

    @classmethod
    def from_dict(cls, data: Any, source: str = "") -> Self:
        """Validate plain data (as `json.loads` gives it).

        Args:
          data: a mapping of field names to values.
          source: what to call it in an error, such as its path.

        Returns:
          The document.

        Raises:
          SpecError: one line for each field that is invalid, missing or unknown.
        """
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise _spec_error(cls, error, source) from None

    def to_dict(self) -> dict[str, Any]:
        """Every field as plain JSON data."""
        return self.model_dump(mode="json")


class Document(StrictModel):
    """A model with an identity: equal documents have equal digests, unequal ones do not."""

    def canonical_json(self) -> bytes:
        """The RFC 8785 canonical JSON of every field."""
        return rfc8785.dumps(self.to_dict())

    @property
    def digest(self) -> str:
        """`sha256:` and 64 hex digits: the identity of this document."""
        return "sha256:" + hashlib.sha256(self.canonical_json()).hexdigest()


def short_repr(value: Any) -> str:
    """A value as an error repeats it: cut to a length that fits on a line."""
    try:
        text = repr(value)
    except RecursionError:
        text = f"a {type(value).__name__} nested too deeply"
    return text if len(text) <= _MAX_REPR else text[: _MAX_REPR - 1] + "…"


class _Named(Protocol):
    @property
    def name(self) -> str: ...


def refuse_repeated_names(field: str, members: Sequence[_Named]) -> None:
    """Raise where two members of a field have the same name.

    Raises:
      ValueError: for Pydantic, which reports it as an error of the document.
    """
    names = [member.name for member in members]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{field}: the name {name!r} appears twice. Rename one of them.")


def _spec_error(model: type[StrictModel], error: ValidationError, source: str) -> SpecError:
    """Pydantic's errors as a SpecError, one line each."""
    lines = error.errors()
    parents = {line["loc"][:depth] for line in lines for depth in range(len(line["loc"]))}
    # Pydantic counts only valid entries: a list of one invalid entry is also "too short".
    lines = [line for line in lines if line["type"] != "too_short" or line["loc"] not in parents]
    texts = [_explain(model, line) for line in lines]
    text = texts[0] if len(texts) == 1 else "".join(f"\n  {text}" for text in texts)
    return SpecError(f"{source or model.__name__}: {text}")


def _explain(model: type[StrictModel], line: ErrorDetails) -> str:
    """One of Pydantic's error lines as `field=value: what is allowed. What to do.`"""
    root = model.model_json_schema()
    location, kind = line["loc"], line["type"]
    path = ".".join(str(part) for part in location)
    value = short_repr(line["input"])
    if kind in ("extra_forbidden", "invalid_key"):
        known = _resolved(root, _schema_at(root, location[:-1])).get("properties", {})
        hint = did_you_mean(str(location[-1]), known) or f" Known fields: {', '.join(known)}."
        if kind == "invalid_key":
            return f"{path}: field names must be strings.{hint}"
        return f"{path}={value}: unknown field.{hint} Rename or remove it."
    schema = _schema_at(root, location)
    if kind == "value_error":
        message = str(line["ctx"]["error"])
        if "properties" not in _resolved(root, schema):
            return f"{path}={value}: {message}"
        return f"{path}.{message}" if path else message  # of a model: names its field
    if kind == "missing":
        return f"{path}: missing: must be {_allowed(root, schema)}. Add it."
    if kind in ("model_type", "model_attributes_type"):
        return f"{path}{': ' if path else ''}must be an object of named fields, got {value}."
    fix = "Correct it."
    if "default" in schema:
        fix = f"Leave it out for the default, {short_repr(schema['default'])}."
    allowed = f"must be {_allowed(root, schema)}" if schema else line["msg"]
    return f"{path}={value}: {allowed}. {fix}"


def _schema_at(root: dict[str, Any], location: tuple[int | str, ...]) -> dict[str, Any]:
    """The JSON Schema of a place in a document; empty where the schema does not describe it."""
    schema = root
    for part in location:
        schema = _resolved(root, schema)
        if isinstance(part, int):
            schema = schema.get("items", {})
        else:
            named = schema.get("properties", {})
            schema = named.get(part) or schema.get("additionalProperties") or {}
    return schema


def _resolved(root: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """The definition that a schema refers to, directly or as an optional value; else itself."""
    for option in schema.get("anyOf", [schema]):
        if "$ref" in option:
            definition: dict[str, Any] = root["$defs"][option["$ref"].rpartition("/")[2]]
            return definition
    return schema


def _allowed(root: dict[str, Any], schema: dict[str, Any]) -> str:
    """What a JSON Schema allows, in words."""
    if "anyOf" in schema:
        return " or ".join(_allowed(root, option) for option in schema["anyOf"])
    if "const" in schema or "enum" in schema:
        return " or ".join(repr(value) for value in schema.get("enum", [schema.get("const")]))
    schema = _resolved(root, schema)
    match schema.get("type"):
        case "integer":
            return "an integer" + _interval(schema)
        case "number":
            return "a finite number" + _interval(schema)
        case "string" if "pattern" in schema and "description" in schema:
            return str(schema["description"])
        case "string":
            return "a string" + _length(schema, "Length", "characters")
        case "array":
            return "a list" + _length(schema, "Items", "entries")
        case "object":
            return f"an object: {', '.join(schema.get('properties', ['names with values']))}"
        case "boolean":
            return "true or false"
    return str(schema.get("type", schema.get("description", "of another form")))


def _interval(schema: dict[str, Any]) -> str:
    low, high = "(−∞", "∞)"
    for bound, value in schema.items():
        match bound:
            case "minimum":
                low = f"[{value}"
            case "exclusiveMinimum":
                low = f"({value}"
            case "maximum":
                high = f"{value}]"
            case "exclusiveMaximum":
                high = f"{value})"
    return "" if (low, high) == ("(−∞", "∞)") else f" in {low}, {high}"


def _length(schema: dict[str, Any], of: str, unit: str) -> str:
    shortest, longest = schema.get(f"min{of}", 0), schema.get(f"max{of}")
    return "" if longest is None else f" of {shortest} to {longest} {unit}"
