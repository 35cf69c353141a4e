"""The base of every document: frozen, strict, hashed by its canonical JSON.

digest = "sha256:" + hex(SHA-256(RFC 8785 canonical JSON of all fields)), so equal documents have
equal digests on every machine, whatever the key order or the way a number was written.
"""

from __future__ import annotations

import hashlib
import types
from typing import Annotated, Any, Literal, Self, Union, get_args, get_origin

import rfc8785
from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import InitErrorDetails, PydanticCustomError

from sme_registry.errors import SpecError, did_you_mean

_EXPLAINED = "document"  # the error type of lines that already are in our words
_NOT_AN_OBJECT = ": must be an object of named fields"
_SHOWN = 60  # characters of a bad value that an error repeats


def plain_number(value: Any) -> Any:
    """NumPy's scalars as Python's, so that a sweep over `np.arange` needs no casts; no booleans.

    Negative zero becomes zero: the two are equal, so they must not differ in text.
    """
    if type(value).__module__ == "numpy" and getattr(value, "ndim", None) == 0:
        kind = value.dtype.kind
        if kind in "iuf":
            value = value.item()
    return value + 0.0 if type(value) is float else value


def _plain_numbers(data: Any) -> Any:
    """`plain_number` of each of a mapping's values, and of the entries of those that are lists.

    Here and not as validators of the fields' types: Pydantic's JSON Schema loses the bounds of a
    number that has a validator of its own.
    """
    if not isinstance(data, dict):
        return data
    return {
        name: [plain_number(entry) for entry in value]
        if type(value) in (list, tuple)
        else plain_number(value)
        for name, value in data.items()
    }


def _integer_only(value: Any) -> Any:
    """Refuse what Python calls equal to an integer: `Literal[1]` takes True and 1.0 for 1."""
    number = plain_number(value)
    if type(number) is not int:
        raise ValueError("not an integer")
    return number


Integer = int
Real = Annotated[float, Field(allow_inf_nan=False)]
SchemaVersion = Annotated[Literal[1], BeforeValidator(_integer_only)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$", min_length=1, max_length=64)]
Digest = Annotated[
    str,
    Field(pattern=r"^sha256:[0-9a-f]{64}$", description="'sha256:' and 64 lower-case hex digits"),
]


def explained(message: str) -> PydanticCustomError:
    """An error for a validator to raise whose text is already field, value, range and fix."""
    return PydanticCustomError(_EXPLAINED, "{message}", {"message": message})


class StrictModel(BaseModel):
    """Frozen and strict; unknown fields are refused, in words that say what to do."""

    # An instance of a subclass has more fields than its place: equal digests, unequal documents.
    model_config = ConfigDict(
        frozen=True,
        strict=True,
        extra="forbid",
        validate_default=False,
        revalidate_instances="subclass-instances",
    )

    @model_validator(mode="wrap")
    @classmethod
    def _in_our_words(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        try:
            return handler(_plain_numbers(data))
        except ValidationError as error:
            lines = [
                InitErrorDetails(
                    type=explained(_explain(cls, line)), loc=line["loc"], input=line["input"]
                )
                for line in _without_echoes(error.errors())
            ]
            raise ValidationError.from_exception_data(cls.__name__, lines) from None

    @classmethod
    def from_dict(cls, data: Any, source: str = "") -> Self:
        """Validate plain data (as `json.loads` gives it).

        Args:
          data: a mapping of field names to values.
          source: what to call it in an error, such as its path.

        Returns:
          The document.

        Raises:
          SpecError: one line for each field that is wrong, missing or unknown.
        """
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            lines = [line["msg"] for line in error.errors()]
            head = f"{source or cls.__name__}: "
            text = lines[0] if len(lines) == 1 else "".join(f"\n  {line}" for line in lines)
            raise SpecError(head + text) from None

    def to_dict(self) -> dict[str, Any]:
        """Every field as plain JSON data."""
        return self.model_dump(mode="json")


class Document(StrictModel):
    """What has an identity: equal documents have equal digests, and the other way round."""

    def canonical_json(self) -> bytes:
        """The RFC 8785 canonical JSON of every field."""
        return rfc8785.dumps(self.to_dict())

    @property
    def digest(self) -> str:
        """`sha256:` and 64 hex digits: the identity of this document."""
        return "sha256:" + hashlib.sha256(self.canonical_json()).hexdigest()


def _without_echoes(lines: list[Any]) -> list[Any]:
    """Drop "too short" where entries were wrong: Pydantic counts only those that were right."""
    return [
        line
        for line in lines
        if line["type"] != "too_short"
        or not any(
            len(other["loc"]) > len(line["loc"]) and other["loc"][: len(line["loc"])] == line["loc"]
            for other in lines
        )
    ]


def _explain(document: type[StrictModel], line: Any) -> str:
    """One of Pydantic's error lines as `field=value: what is allowed. What to do.`"""
    location, value = line["loc"], line["input"]
    if line["type"] == _EXPLAINED:
        return _from_the_root(
            str(line["msg"]), location, nested=isinstance(value, dict | BaseModel)
        )
    if not location:
        return f"{document.__name__}{_NOT_AN_OBJECT}, got {show(value)}."
    path = ".".join(str(part) for part in location)
    fields = document.model_fields
    name = str(location[0])
    if line["type"] == "extra_forbidden":
        hint = did_you_mean(name, fields) or f" Known fields: {', '.join(fields)}."
        return f"{path}={show(value)}: unknown field.{hint} Rename or remove it."
    if name not in fields:  # a key that is not a string
        return f"{path}: field names must be strings. Known fields: {', '.join(fields)}."
    field = fields[name]
    if line["type"] == "missing":
        return f"{path}: missing: must be {_allowed(field)}. Add it."
    fix = "Correct it."
    if not field.is_required() and len(location) == 1:
        fix = f"Leave it out for the default, {show(field.get_default(call_default_factory=True))}."
    allowed = f"must be {_allowed(field)}" if len(location) == 1 else str(line["msg"])
    return f"{path}={show(value)}: {allowed}. {fix}"


def _from_the_root(message: str, location: tuple[int | str, ...], *, nested: bool) -> str:
    """A nested document's line with its field's whole path: `team.agents.1.observes=…`."""
    parts = [str(part) for part in location]
    path = ".".join(parts)
    for start in range(len(parts)):
        tail = ".".join(parts[start:])
        if message.startswith((f"{tail}=", f"{tail}:")):
            return path + message[len(tail) :]
    if not parts:
        return message
    if _NOT_AN_OBJECT in message:
        return path + message[message.index(_NOT_AN_OBJECT) :]
    if isinstance(location[-1], int) and not nested:  # one entry of a list of scalars
        return path + message[message.index("=") :]
    return f"{path}.{message}"


def show(value: Any) -> str:
    """A bad value as an error repeats it: cut to a length that fits a line."""
    try:
        text = repr(value)
    except RecursionError:
        text = f"a {type(value).__name__} nested too deeply"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"


def _allowed(field: FieldInfo) -> str:
    """The values a field takes, in words."""
    low, high = "", ""
    shortest, longest, pattern = 0, 0, None
    for bound in field.metadata:
        pattern = getattr(bound, "pattern", None) or pattern
        match bound:
            case Ge(ge=limit):
                low = f"[{limit}"
            case Gt(gt=limit):
                low = f"({limit}"
            case Le(le=limit):
                high = f"{limit}]"
            case Lt(lt=limit):
                high = f"{limit})"
            case MinLen(min_length=shortest):
                pass
            case MaxLen(max_length=longest):
                pass
    if field.annotation is str:
        if pattern is not None and field.description:
            return field.description
        letters = "letters, digits, '_' and '-'" if pattern is not None else "characters"
        return f"a string of {shortest} to {longest} {letters}"
    span = f"in {low or '(−∞'}, {high or '∞)'}" if low or high else ""
    if longest:
        span = f"of {shortest} to {longest} entries"
    kind = _kind(field.annotation)
    return f"{kind} {span}".strip() if kind else (span or field.description or "of another form")


def _kind(annotation: Any) -> str:
    origin = get_origin(annotation)
    if origin is Annotated:
        return _kind(get_args(annotation)[0])
    if annotation is int:
        return "an integer"
    if annotation is float:
        return "a finite number"
    if origin is Literal:
        return " or ".join(repr(choice) for choice in get_args(annotation))
    if origin is tuple:
        return "a list"
    if origin in (Union, types.UnionType):
        return " or ".join(filter(None, (_kind(member) for member in get_args(annotation))))
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return f"an object: {', '.join(annotation.model_fields)}"
    if annotation is type(None):
        return "null"
    return ""
