"""The base of every document: frozen, strict, hashed by its canonical JSON.

digest = "sha256:" + hex(SHA-256(RFC 8785 canonical JSON of all fields)), so equal documents have
equal digests on every machine, regardless of key order and of how a number was written.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Sized
from typing import Annotated, Any, ClassVar, Literal, Protocol, Self, TypeVar

import rfc8785
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)
from pydantic_core import CoreSchema

from sme_registry.errors import DigestMismatchError
from sme_registry.io import sha256_of
from sme_registry.spec.descriptions import describe, describe_schema
from sme_registry.spec.validation_errors import WORDED, spec_error


def plain_number(value: Any) -> Any:
    """NumPy's numbers as Python's, and −0.0 as 0.0: equal values must not differ in text."""
    if type(value).__module__ == "numpy" and getattr(value, "ndim", None) == 0:
        kind = value.dtype.kind
        if kind in "iuf":
            value = value.item()
    return value + 0.0 if type(value) is float else value


def _integer_only(value: Any) -> Any:
    """Reject what Python calls equal to an integer: `Literal[1]` takes True and 1.0 for 1."""
    number = plain_number(value)
    if type(number) is not int:
        raise ValueError("must be 1. Correct it, or leave it out for the default, 1.")
    return number


_Part = TypeVar("_Part")

Integer = int
Real = Annotated[float, Field(allow_inf_nan=False)]
TupleOf = Annotated[tuple[_Part, ...], Field(strict=False)]  # in JSON a list
SchemaVersion = Annotated[
    Literal[1],
    BeforeValidator(_integer_only),
    Field(description="version of the document's format."),
]


def matching(pattern: str, allowed: str, **limits: Any) -> Any:
    """The `Field` of a text that matches a pattern.

    Examples:
      >>> from typing import Annotated
      >>> from sme_registry.spec import StrictModel, matching
      >>> class Colour(StrictModel):
      ...     code: Annotated[str, matching("^#[0-9a-f]{6}$", "'#' and 6 hex digits")]
      >>> Colour(code="red")
      Traceback (most recent call last):
      ...
      sme_registry.errors.SpecError: Colour: code='red': must be '#' and 6 hex digits. Correct it.
    """
    return Field(pattern=pattern, json_schema_extra={WORDED: allowed}, **limits)


Name = Annotated[
    str,
    matching(
        r"^[A-Za-z0-9_-]+$",
        "a string of 1 to 64 letters, digits, '_' and '-'",
        min_length=1,
        max_length=64,
    ),
]
Digest = Annotated[
    str, matching(r"^sha256:[0-9a-f]{64}$", "'sha256:' and 64 lower-case hex digits")
]


_LONGEST_FIELD = 100  # characters of a field in `repr`


class _Abbreviated:
    """A long field in the `repr` of a model."""

    def __init__(self, value: Any) -> None:
        self._value = value

    def __repr__(self) -> str:
        size = f" of {len(self._value)}" if isinstance(self._value, Sized) else ""
        return f"<{type(self._value).__name__}{size}>"


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
            raise spec_error(error, type(self).__name__, self.model_json_schema()) from None

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        describe(cls)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        schema = handler(core_schema)
        describe_schema(cls, handler.resolve_ref_schema(schema))
        return schema

    # The mark of Pydantic's own constructors: without it, each nested model would be validated by
    # this one, and raise an error without the path that leads to it.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @model_validator(mode="before")
    @classmethod
    def _plain_numbers(cls, data: Any) -> Any:
        """`plain_number` of every value; validators of fields would cost the schema its bounds."""
        if not isinstance(data, dict):
            return data
        return {
            name: [plain_number(entry) for entry in value]
            if type(value) in (list, tuple)
            else plain_number(value)
            for name, value in data.items()
        }

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """The fields; a long one is shown by its type and length, so that none fills a screen."""
        for name, value in super().__repr_args__():
            yield name, value if len(repr(value)) <= _LONGEST_FIELD else _Abbreviated(value)

    @classmethod
    def from_dict(cls, data: Any, source: str = "") -> Self:
        """Validate plain data; a `SpecError` has a line for each fault, and calls it `source`."""
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise spec_error(error, source or cls.__name__, cls.model_json_schema()) from None

    def to_dict(self) -> dict[str, Any]:
        """Every field as plain JSON data."""
        return self.model_dump(mode="json")


def refuse_other_digest(stated: str, document: Document, where: str, remedy: str) -> None:
    """Raise `DigestMismatchError` if a document has another digest than a file states."""
    if stated != document.digest:
        raise DigestMismatchError(
            f"{where}={stated!r:.90}: its document has the digest {document.digest!r}. One of them "
            f"was changed later. {remedy}"
        )


def without_empty(plain: dict[str, Any], *names: str) -> dict[str, Any]:
    """Plain data without those of these fields that are empty, as before the fields existed."""
    return {key: value for key, value in plain.items() if value or key not in names}


class Document(StrictModel):
    """A model with an identity: equal documents have equal digests, unequal ones do not."""

    # Fields younger than the first documents of this kind. While they have their default they are
    # in no JSON, so that the digests of older documents stay the same.
    left_out_by_default: ClassVar[tuple[str, ...]] = ()

    @model_serializer(mode="wrap")
    def _without_young_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields: dict[str, Any] = handler(self)
        for name in self.left_out_by_default:
            if getattr(self, name) == type(self).model_fields[name].default:
                fields.pop(name, None)
        return fields

    def every_field(self) -> dict[str, Any]:
        """As `to_dict`, with the fields that it leaves out; for people, and to compare."""
        young = {name: getattr(self, name) for name in self.left_out_by_default}
        return {**young, **self.to_dict()}

    def canonical_json(self) -> bytes:
        """The RFC 8785 canonical JSON of every field."""
        return rfc8785.dumps(self.to_dict())

    @property
    def digest(self) -> str:
        """`sha256:` and 64 hex digits: the identity of this document."""
        return sha256_of(self.canonical_json())


class NamedDocument(Document):
    """A document that a file or a registration may give a name, which is presentation.

    The name is in no JSON, and makes no two documents unequal.
    """

    _name: str = PrivateAttr("")

    @property
    def name(self) -> str:
        """What its file or registration calls it, such as `MyTask`; empty if nothing does."""
        return self._name

    def named(self, name: str) -> Self:
        """This document under another name."""
        copy = self.model_copy()
        copy._name = name
        return copy

    @property
    def content_name(self) -> str:
        """`sha256-` and the first 12 hex digits of the digest: the name by content."""
        return self.digest.replace(":", "-")[: len("sha256-") + 12]

    def __eq__(self, other: object) -> bool:
        """Whether all fields are equal; the name is none of them."""
        if type(other) is not type(self):
            return NotImplemented
        return self.__dict__ == other.__dict__


class _Named(Protocol):
    @property
    def name(self) -> str: ...


def refuse_repeated_names(field: str, members: Sequence[_Named]) -> None:
    """Raise ValueError, which Pydantic reports, where two members have the same name."""
    names = [member.name for member in members]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{field}: the name {name!r} appears twice. Rename one of them.")
