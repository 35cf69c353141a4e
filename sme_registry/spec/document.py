"""The base of every document: frozen, strict, hashed by its canonical JSON (RFC 8785).

Each field has one text, its entry under "Attributes:" in the docstring of the class or of its base:
`help`, the JSON Schema and the pages of `docs/` show it.
"""

from __future__ import annotations

import inspect
import os
import re
import textwrap
from collections.abc import Callable, Iterator, Sequence, Sized
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, TypeVar, cast, get_args

import rfc8785
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    JsonValue,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, ErrorDetails

from sme_registry.errors import DigestMismatchError, SpecError, UnknownNameError, did_you_mean
from sme_registry.io import read_json, sha256_of, to_json, write_atomically

_words: dict[str, str] = {}  # of patterns
_ENDS = ("ge", "gt", "le", "lt")
_MAX_FAULTS, _MAX_TEXT = 5, 2000  # of errors
_LONGEST_FIELD = 100  # characters of a field in `repr`
_ENTRY = re.compile(r"^  (\w+(?:, \w+)*): ", re.M)  # under "Attributes:"

WORDED = "$comment"
"""The keyword under which our JSON Schemas say in words what a pattern allows."""


def short_repr(value: Any) -> str:
    """A value as an error repeats it: cut to a length that fits on a line."""
    try:
        return _shortened(repr(value), 60)
    except RecursionError:
        return f"a {type(value).__name__} nested too deeply"


def _shortened(text: str, longest: int) -> str:
    return text if len(text) <= longest else text[: longest - 1] + "…"


def _spec_error(error: ValidationError, source: str, model: type[BaseModel]) -> SpecError:
    """Pydantic's first five errors, one line each: a document chooses how many it has."""
    lines = error.errors()
    parents = {line["loc"][:depth] for line in lines for depth in range(len(line["loc"]))}
    # Pydantic counts only valid entries: a list of one invalid entry is also "too short".
    lines = [line for line in lines if line["type"] != "too_short" or line["loc"] not in parents]
    texts = [_explain(model, line) for line in lines[:_MAX_FAULTS]]
    if len(lines) > len(texts):
        texts.append(f"… and {len(lines) - len(texts):,} more faults.")
    text = texts[0] if len(texts) == 1 else "".join(f"\n  {text}" for text in texts)
    return SpecError(_shortened(f"{source}: {text}", _MAX_TEXT))


def _explain(model: type[BaseModel], line: ErrorDetails) -> str:
    """One of Pydantic's errors as `field=value: what is allowed. What to do.`"""
    location, kind = line["loc"], line["type"]
    path = _shortened(".".join(map(str, location)), 120).replace("\n", "\\n")
    value = f"{path}={short_repr(line['input'])}" if path else short_repr(line["input"])
    fields = _fields_at(model, location[:-1])
    if kind == "missing":
        return f"{path}: missing. Add it."
    if location[-1:] == ("schema_version",) and str(line["input"]).isdecimal():
        return f"{value}: a newer version wrote it. Upgrade: pip install --upgrade sme-registry."
    if kind == "extra_forbidden":
        near = did_you_mean(str(location[-1])[:120], fields)
        known = f" Known fields: {', '.join(fields)}." if fields else ""
        return f"{value}: unknown field.{near or known} Rename or remove it."
    if kind == "value_error":
        message = str(line["ctx"]["error"])
        of_model = isinstance(line["input"], dict | BaseModel) and _fields_at(model, location)
        if not of_model:
            return f"{value}: {message}"
        return f"{path}.{message}" if path else message  # which names the model's field
    field = fields.get(str(location[-1])) if location else None
    allowed = re.sub("^(Input|Tuple|String) should|should", "must", line["msg"], count=1)
    allowed = allowed.replace(" after validation", "")
    if kind == "string_pattern_mismatch":
        allowed = f"must be {_words.get(line['ctx']['pattern'], allowed)}"
    elif field is not None and "too_" not in kind and (interval := _interval(field)):
        is_bound = kind.startswith(("greater_than", "less_than"))
        allowed = f"must be{interval}" if is_bound else allowed + interval
    if field is None or field.default is None or field.is_required():
        return f"{value}: {allowed}. Correct it."
    default = short_repr(field.get_default(call_default_factory=True, validated_data={}))
    return f"{value}: {allowed}. Correct it, or leave it out for the default, {default}."


def _interval(field: FieldInfo) -> str:
    """` in [1, 4096]`, from the limits of a number; empty where it has none."""
    options = [entry for kind in get_args(field.annotation) for entry in get_args(kind)]
    limits = [one for entry in options for one in getattr(entry, "metadata", ())] + field.metadata
    ends: dict[str, Any] = {}
    for limit in limits:
        ends |= {name: getattr(limit, name) for name in _ENDS if hasattr(limit, name)}
    if not ends:
        return ""
    lowest = f"[{ends['ge']}" if "ge" in ends else f"({ends.get('gt', '−∞')}"
    return f" in {lowest}, " + (f"{ends['le']}]" if "le" in ends else f"{ends.get('lt', '∞')})")


def _fields_at(model: type[BaseModel], location: tuple[int | str, ...]) -> dict[str, FieldInfo]:
    fields = model.model_fields
    for part in location:
        if part in fields:
            inner = next(_models(fields[str(part)].annotation), None)
            fields = {} if inner is None else inner.model_fields
    return fields


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models(argument)


def _sections(kind: type[BaseModel]) -> tuple[str, dict[str, str], str]:
    """A docstring's text before its attributes, they by name, and the sections after them."""
    before, _, section = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")
    section, _, after = section.partition("\n\n")
    parts = _ENTRY.split(section)
    entries = {
        name: " ".join(entry.split())
        for names, entry in zip(parts[1::2], parts[2::2], strict=True)
        for name in names.split(", ")
    }
    return before.strip(), entries, after.strip()


def summary(kind: type[BaseModel]) -> str:
    """A class's docstring without its fields and examples."""
    before, _, after = _sections(kind)
    return f"{before}\n\n{after}".partition("\n\nExamples:\n")[0].strip()


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
_D = TypeVar("_D", bound="NamedDocument")

Integer = int
Real = Annotated[float, Field(allow_inf_nan=False)]
TupleOf = Annotated[tuple[_Part, ...], Field(strict=False)]  # in JSON a list
SchemaVersion = Annotated[
    Literal[1],
    BeforeValidator(_integer_only),
    Field(description="version of the document's format."),
]


def matching(pattern: str, allowed: str, **limits: Any) -> Any:
    """The `Field` of a text that matches a pattern; `allowed` says in words what that is."""
    _words[pattern] = allowed
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


class _Unquoted(str):
    __repr__ = str.__str__


class FieldMark(NamedTuple):
    """What `Annotated` says of a field, besides its type."""

    text: str


LATER = FieldMark("added later")
"""Of a field that is in no JSON while it has its default: older documents keep their digests."""


class StrictModel(BaseModel):
    """Frozen and strict; invalid and unknown fields are errors that say how to correct them."""

    fields_added_later: ClassVar[tuple[str, ...]] = ()  # or those that are marked `LATER`

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
            raise _spec_error(error, type(self).__name__, type(self)) from None

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        before, entries, after = _sections(cls)
        cls.fields_added_later = cls.marked(LATER) or cls.fields_added_later
        lines = []
        for name, field in cls.model_fields.items():
            field.description = entries.get(name, field.description)
            if field.description:
                text = f"  {name}: {field.description}"
                lines.append(textwrap.fill(text, 96, subsequent_indent=" " * 4))
        if cls.__doc__ and lines:
            fields = "Attributes:\n" + "\n".join(lines)
            cls.__doc__ = "\n\n".join(filter(None, (before, fields, after))) + "\n"

    @classmethod
    def marked(cls, mark: FieldMark) -> tuple[str, ...]:
        """The fields with a mark, in order."""
        return tuple(name for name, field in cls.model_fields.items() if mark in field.metadata)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        schema = handler(core_schema)
        place = handler.resolve_ref_schema(schema)
        if text := summary(cls):
            place["description"] = text
        for name, field in cls.model_fields.items():
            if field.description:
                place["properties"][name]["description"] = field.description
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

    @model_serializer(mode="wrap")
    def _without_later_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields: dict[str, Any] = handler(self)
        for name in self.fields_added_later:
            if getattr(self, name) == type(self).model_fields[name].default:
                fields.pop(name, None)
        return fields

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """The fields; a long one is shown by its type and length, so that none fills a screen."""
        for name, value in super().__repr_args__():
            if len(repr(value)) <= _LONGEST_FIELD:
                yield name, value
            else:
                size = f" of {len(value)}" if isinstance(value, Sized) else ""
                yield name, _Unquoted(f"<{type(value).__name__}{size}>")

    @classmethod
    def from_dict(cls, data: Any, source: str = "") -> Self:
        """Validate plain data; a `SpecError` has a line for each fault, and calls it `source`."""
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise _spec_error(error, source or cls.__name__, cls) from None

    def to_dict(self) -> dict[str, Any]:
        """Every field as plain JSON data."""
        return self.model_dump(mode="json")


def check_digest(stated: str, document: Document, where: str, remedy: str) -> None:
    if stated != document.digest:
        raise DigestMismatchError(
            f"{where}={stated!r:.90}: its document has the digest {document.digest!r}. One of them "
            f"was changed later. {remedy}"
        )


class StoredModel(StrictModel):
    """What a JSON file holds whole."""

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read and validate a file."""
        return cls.from_dict(read_json(path), os.fspath(path))

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write it as JSON, completely or not at all."""
        return write_atomically(path, to_json(self.to_dict()))


class DigestedFile(StoredModel):
    """A file with documents, and the digests that they had when it was written."""

    documents: ClassVar[tuple[str, ...]]  # fields, of each of which `<document>_digest` exists
    remedy: ClassVar[str]  # where a digest is of another document

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that `write` wrote."""
        content = super().read(path)
        for name in content.documents:
            stated, where = getattr(content, f"{name}_digest"), f"{path}: {name}_digest"
            check_digest(stated, getattr(content, name), where, cls.remedy)
        return content


def without_empty(plain: dict[str, Any], *names: str) -> dict[str, Any]:
    """Plain data without those of these fields that are empty, as before the fields existed."""
    return {key: value for key, value in plain.items() if value or key not in names}


class Document(StrictModel):
    """A model with an identity: equal documents have equal digests, unequal ones do not."""

    def every_field(self) -> dict[str, Any]:
        """As `to_dict`, with the fields that it leaves out; for people, and to compare."""
        later = {name: getattr(self, name) for name in self.fields_added_later}
        return {**later, **self.to_dict()}

    def canonical_json(self) -> bytes:
        """The RFC 8785 canonical JSON of every field."""
        return rfc8785.dumps(self.to_dict())

    @property
    def digest(self) -> str:
        """`sha256:` and 64 hex digits: the identity of this document."""
        return sha256_of(self.canonical_json())


def _writable(value: dict[str, Any]) -> dict[str, Any]:
    """A value whose canonical JSON tells it from others: without infinities, NaN and 2⁵³ + 1."""
    try:
        rfc8785.dumps(value)
    except rfc8785.CanonicalizationError as error:
        raise ValueError(f"must be plain, finite JSON: {error}") from None
    return value


PlainJson = Annotated[dict[str, JsonValue], AfterValidator(_writable)]


class NamedDocument(Document):
    """A document that a file or registration may name; the name is in no JSON and no comparison."""

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

    def _repr_html_(self) -> str:
        from sme_registry.spec import cards  # which knows every kind of document

        return cards.html(cast(Any, self))

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return self.__dict__ == other.__dict__


finders: dict[type[NamedDocument], Callable[[Any], NamedDocument]] = {}
"""Kind → what finds a document by its name. `resolve` fills it, which imports every kind."""


def find_named(kind: type[NamedDocument], value: Any) -> Any:
    """The document of a name, without the name; ValueError, which Pydantic reports, if none."""
    if not isinstance(value, str | os.PathLike):
        return value
    try:
        return finders[kind](value).named("")
    except (UnknownNameError, SpecError) as error:
        raise ValueError(str(error)) from None


def check_names(field: str, members: Sequence[Any]) -> None:
    names = [member.name for member in members]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{field}: the name {name!r} appears twice. Rename one of them.")
