"""Pydantic's validation errors as messages with field, value, allowed range and fix.

The allowed range is read from the JSON Schema of the document, so it is written in one place only.
"""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from sme_registry.errors import SpecError, did_you_mean

_MAX_REPR = 60
_MAX_PATH = 120
_MAX_FAULTS = 5
_MAX_TEXT = 2000

WORDED = "$comment"
"""The keyword under which our JSON Schemas say in words what a pattern allows."""


def short_repr(value: Any) -> str:
    """A value as an error repeats it: cut to a length that fits on a line."""
    try:
        text = repr(value)
    except RecursionError:
        text = f"a {type(value).__name__} nested too deeply"
    return _shortened(text, _MAX_REPR)


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"


def spec_error(error: ValidationError, source: str, schema: dict[str, Any]) -> SpecError:
    """Pydantic's first five errors as a SpecError of at most 2,000 characters, one line each."""
    lines = error.errors()
    parents = {line["loc"][:depth] for line in lines for depth in range(len(line["loc"]))}
    # Pydantic counts only valid entries: a list of one invalid entry is also "too short".
    lines = [line for line in lines if line["type"] != "too_short" or line["loc"] not in parents]
    texts = [_explain(schema, line) for line in lines[:_MAX_FAULTS]]
    if len(lines) > len(texts):
        texts.append(f"… and {len(lines) - len(texts):,} more faults.")
    text = texts[0] if len(texts) == 1 else "".join(f"\n  {text}" for text in texts)
    return SpecError(_shortened(f"{source}: {text}", _MAX_TEXT))


def _explain(root: dict[str, Any], line: ErrorDetails) -> str:
    """One of Pydantic's error lines as `field=value: what is allowed. What to do.`"""
    location, kind = line["loc"], line["type"]
    path = _shortened(".".join(str(part) for part in location), _MAX_PATH)
    value, schema = short_repr(line["input"]), _schema_at(root, location)
    if kind in ("extra_forbidden", "invalid_key"):
        known = _resolved(root, _schema_at(root, location[:-1])).get("properties", {})
        hint = (
            did_you_mean(str(location[-1])[:_MAX_PATH], known)
            or f" Known fields: {', '.join(known)}."
        )
        if kind == "invalid_key":
            return f"{path}: field names must be strings.{hint}"
        return f"{path}={value}: unknown field.{hint} Rename or remove it."
    if kind == "value_error":
        message = str(line["ctx"]["error"])
        if "properties" not in _resolved(root, schema):
            return f"{path}={value}: {message}"
        return f"{path}.{message}" if path else message  # of a model: names its field
    if kind == "missing":
        return f"{path}: missing: must be {allowed_values(root, schema)}. Add it."
    if kind in ("model_type", "model_attributes_type"):
        fields = _resolved(root, schema).get("properties", {}) if path else {}
        known = f" Known fields: {', '.join(fields)}." if fields else ""
        return f"{path}{': ' if path else ''}must be an object of named fields, got {value}.{known}"
    fix = "Correct it."
    if schema.get("default") is not None:
        fix = f"Correct it, or leave it out for the default, {short_repr(schema['default'])}."
    allowed = f"must be {allowed_values(root, schema)}" if schema else line["msg"]
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


def allowed_values(root: dict[str, Any], schema: dict[str, Any]) -> str:
    """What a JSON Schema allows, in words."""
    if "anyOf" in schema:
        return " or ".join(allowed_values(root, option) for option in schema["anyOf"])
    if "const" in schema or "enum" in schema:
        return " or ".join(repr(value) for value in schema.get("enum", [schema.get("const")]))
    schema = _resolved(root, schema)
    match schema.get("type"):
        case "integer":
            return "an integer" + _interval(schema)
        case "number":
            return "a finite number" + _interval(schema)
        case "string" if WORDED in schema:
            return str(schema[WORDED])
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
