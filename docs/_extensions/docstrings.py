"""Docstrings of this project as reStructuredText, which autodoc and napoleon read.

They are written to be read as text: code is in single backticks, and formulas and examples
are indented blocks. Doctests stay as they are. Types of NumPy have their own names in signatures,
not what these stand for; a document's fields have their types and defaults, and nothing of
Pydantic's; named constants and factories are the values that they give.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
from typing import Any, get_type_hints

import numpy.typing as npt
from pydantic import BaseModel
from sphinx.application import Sphinx
from sphinx.util.typing import stringify_annotation

_CODE = re.compile(r"(?<![`\w])`([^`]+)`(?!`)")
_SPECIAL = re.compile(r"([*|]|(?<=\w)_(?!\w))")
_SEVERAL = re.compile(r"^(:(?:ivar|param|raises) )([^:]*, [^:]*):")
_ARRAY = re.compile(r"ndarray\[tuple\[Any, \.\.\.\], dtype\[([\w.]+)\]\]")
_CONSTANT = re.compile(r"(= ?)([A-Z][A-Z_]+)\b(?!\.)")
_ARRAY_LIKE = stringify_annotation(npt.ArrayLike, "smart")


def short_types(signature: str) -> str:
    """A signature with `NDArray` and `ArrayLike` in place of what they stand for."""
    plain = signature.replace(_ARRAY_LIKE, "ArrayLike")
    for module in ("numpy.", "typing."):
        plain = plain.replace(f"~{module}", "")
    return _ARRAY.sub(r"NDArray[\1]", plain.replace("~tuple", "tuple"))


def as_rst(lines: list[str]) -> list[str]:
    """A docstring, in lines, as reStructuredText; its sections are napoleon's business."""
    result: list[str] = []
    prose: list[str] = []
    literal = -1  # the indentation of a block of code, or −1 outside
    base = 0  # the indentation of the text around it

    def flush() -> None:
        if prose:
            result.extend(_inline("\n".join(prose)).split("\n"))
            prose.clear()

    for line in lines:
        indent = len(line) - len(line.lstrip())
        if not line.strip():
            flush()
            result.append("")
            continue
        if literal >= 0 and indent < literal:
            literal = -1
        if literal < 0 and indent >= base + 4 and not prose and result:
            literal = indent
            result += [" " * base + "::", ""]
        if literal >= 0 or line.lstrip().startswith((">>>", "...")):
            flush()
            result.append(line)
        else:
            base = indent
            prose.append(line)
    flush()
    return result


def _inline(text: str) -> str:
    parts = _CODE.split(text)
    texts = [_SPECIAL.sub(r"\\\1", part) for part in parts[::2]]
    for index, code in enumerate(parts[1::2], 1):
        joined = "\\ " if texts[index][:1].isalnum() else ""  # as in `SMEEnv`s
        texts[index] = f"``{code}``{joined}{texts[index]}"
    return "".join(texts)


def _before_napoleon(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    if what == "data" and "\n".join(lines).strip() == (inspect.getdoc(type(obj)) or "").strip():
        lines.clear()  # that of its type, such as dict
    lines[:] = as_rst(lines)


def _after_napoleon(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """`low, high: text` describes two names; to Sphinx it would be one of the type `low,`."""
    if _is_document(obj):  # its signature has the types, and the page of files what is allowed
        lines[:] = [line for line in lines if not line.startswith(":vartype ")]
    lines[:] = [_SEVERAL.sub(lambda m: m[1] + m[2].replace(", ", ",") + ":", ln) for ln in lines]


def _on_signature(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, arguments: str, returns: str
) -> tuple[str | None, str | None]:
    if arguments and _is_document(obj):
        arguments = _fields(obj)
    elif arguments:
        arguments = _with_values(arguments, obj)
    return arguments and short_types(arguments), returns and short_types(returns)


def _is_document(obj: Any) -> bool:
    return inspect.isclass(obj) and issubclass(obj, BaseModel)


def _fields(model: type[BaseModel]) -> str:
    types, fields = get_type_hints(model), []
    for name, field in model.model_fields.items():
        fields.append(f"{name}: {stringify_annotation(types[name], 'smart')}")
        if not field.is_required():
            default = field.get_default(call_default_factory=True, validated_data={})
            plain = f"{type(default).__name__}()" if _is_document(type(default)) else repr(default)
            fields[-1] += f" = {plain}"
    return f"(*, {', '.join(fields)})"


def _with_values(arguments: str, obj: Any) -> str:
    if dataclasses.is_dataclass(obj):
        for field in dataclasses.fields(obj):
            if field.default_factory is not dataclasses.MISSING:
                value = repr(field.default_factory())
                arguments = arguments.replace("<factory>", value, 1)
    module = sys.modules.get(getattr(obj, "__module__", None) or "")

    def value_of(default: re.Match[str]) -> str:
        equals, name = default.groups()
        return f"{equals}{getattr(module, name)!r}" if hasattr(module, name) else default[0]

    return _CONSTANT.sub(value_of, arguments)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("autodoc-process-signature", _on_signature)
    app.connect("autodoc-process-docstring", _before_napoleon, priority=400)
    app.connect("autodoc-process-docstring", _after_napoleon, priority=600)
    return {"parallel_read_safe": True}
