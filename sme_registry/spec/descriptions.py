"""One text for each field of a document: its entry under "Attributes:" in the class's docstring.

`help`, the JSON Schema and the pages of `docs/` show that text. What a field allows and its default
follow from the field itself, so no range is written twice. A field that a class inherits has the
entry of its base.
"""

from __future__ import annotations

import inspect
import re
import textwrap
import types
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, WithJsonSchema
from pydantic.fields import FieldInfo

from sme_registry.spec.validation_errors import allowed_values, short_repr

_SECTION = "Attributes:\n"
_ENTRY = re.compile(r"^  (\w+(?:, \w+)*): ", re.M)
_WIDTH = 96
_TYPES = {int: "integer", float: "number", bool: "boolean", str: "string", dict: "object"}
_BOUNDS = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}
_LENGTHS = {"min_length": "min", "max_length": "max"}


def describe(kind: type[BaseModel]) -> None:
    """Take the fields' descriptions from a class's docstring, which then gives their ranges too."""
    if not kind.__doc__ or not kind.model_fields:
        return
    before, entries, after = _sections(kind.__doc__)
    lines = []
    for name, field in kind.model_fields.items():
        if name in entries:
            field.description = " ".join(entries[name].split())
            lines.append(f"  {name}: {entries[name]}")
        elif field.description:
            text = f"  {name}: {field.description}"
            lines.append(textwrap.fill(text, _WIDTH, subsequent_indent=" " * 4))
        else:
            continue
        default = default_of(field)
        words = allowed(field) + (f"; default: {default}" if default else "")
        lines.append(f"    {words[:1].upper()}{words[1:]}.")
    fields = _SECTION + "\n".join(lines) if lines else ""
    kind.__doc__ = "\n\n".join(part for part in (before, fields, after) if part) + "\n"


def summary(kind: type[BaseModel]) -> str:
    """A class's docstring without its fields and examples."""
    before, _, after = _sections(kind.__doc__ or "")
    return f"{before}\n\n{after}".partition("\n\nExamples:\n")[0].strip()


def describe_schema(kind: type[BaseModel], schema: dict[str, Any]) -> None:
    """Write the descriptions of a class and its fields into its JSON Schema, in place."""
    if text := summary(kind):
        schema["description"] = text
    for name, field in kind.model_fields.items():
        if field.description:
            schema["properties"][name]["description"] = field.description


def allowed(field: FieldInfo) -> str:
    """What a field allows, in words: `an integer in [1, 4096]`, or `` `TeamSpec` or null ``."""
    schema = _schema(field.annotation, [field])
    return " or ".join(
        f"`{option['$ref']}`" if "$ref" in option else allowed_values({}, option)
        for option in schema.get("anyOf", [schema])
    )


def default_of(field: FieldInfo) -> str:
    """A field's default as in JSON; empty where the field is required."""
    if field.is_required():
        return ""
    default = field.get_default(call_default_factory=True, validated_data={})
    if default is None:
        return "null"
    if isinstance(default, BaseModel):
        return f"{type(default).__name__}()"
    return short_repr(list(default) if isinstance(default, tuple) else default)


def _schema(annotation: Any, metadata: Sequence[Any]) -> dict[str, Any]:
    """A type's JSON Schema, as far as `allowed_values` reads it; Pydantic's own takes 10 ms."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _schema(arguments[0], [*arguments[1:], *metadata])
    limits = dict(_limits(metadata))
    if "given" in limits:
        return dict(limits["given"])
    if origin in (Union, types.UnionType):
        options = [_schema(argument, metadata) for argument in arguments]
        inner = [option.get("anyOf", [option]) for option in options]
        return {"anyOf": [option for each in inner for option in each]}
    if origin is Literal:
        return {"enum": list(arguments)}
    if annotation is type(None):
        return {"type": "null"}
    kind = origin or annotation
    if inspect.isclass(kind) and issubclass(kind, BaseModel):
        return {"$ref": kind.__name__}
    if kind in (tuple, list):
        return {"type": "array"} | {f"{bound}Items": limits[bound] for bound in limits}
    lengths = {f"{bound}Length": limits[bound] for bound in ("min", "max") if bound in limits}
    return {"type": _TYPES[kind], **limits, **lengths} if kind in _TYPES else {}


def _limits(metadata: Sequence[Any]) -> Iterator[tuple[str, Any]]:
    for entry in metadata:
        if isinstance(entry, WithJsonSchema):
            yield "given", entry.json_schema
        elif isinstance(entry, FieldInfo):
            yield from _limits(entry.metadata)
            if isinstance(entry.json_schema_extra, dict):
                yield from entry.json_schema_extra.items()
        else:
            for name, word in (_BOUNDS | _LENGTHS).items():
                if getattr(entry, name, None) is not None:
                    yield word, getattr(entry, name)


def _sections(docstring: str) -> tuple[str, dict[str, str], str]:
    """A docstring's text before its attributes, they by name, and the sections after them."""
    before, _, section = inspect.cleandoc(docstring).partition(_SECTION)
    section, _, after = section.partition("\n\n")
    parts = _ENTRY.split(section)
    entries = {
        name: entry.strip()
        for names, entry in zip(parts[1::2], parts[2::2], strict=True)
        for name in names.split(", ")
    }
    return before.strip(), entries, after.strip()
