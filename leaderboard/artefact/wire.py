"""A strict reader of protocol buffers: the fields of a message, one by one, without copies.

    field  = tag value            tag = varint(number << 3 | type)
    type 0 = varint               seven bits a byte, lowest first; the high bit: more follow
    type 1 = 8 bytes, type 5 = 4 bytes
    type 2 = varint(length) and as many bytes: text, bytes, a message, or packed numbers

It is stricter than the format, so that every other reader sees the same in these bytes: numbers
must be in their shortest form, and groups (types 3 and 4) are rejected. Values are views of the
bytes. Nested messages are read only on request. Every field and packed number costs one unit of a
`Budget`, which bounds memory and time.

Source: Protocol Buffers, "Encoding".
"""

from __future__ import annotations

from collections.abc import Iterator

VARINT, FIXED64, LENGTH, FIXED32 = 0, 1, 2, 5

_FIXED_BYTES = {FIXED64: 8, FIXED32: 4}
_MAX_FIELD = 2**29 - 1


class WireError(ValueError):
    """The bytes are not a message."""


class BudgetError(ValueError):
    """The message has more fields than the budget allows."""


Field = tuple[int, int, int | memoryview]
"""Number, wire type and value: a varint's number, in [0, 2⁶⁴), or else a view of the bytes."""


class Budget:
    """The number of fields and packed numbers that may still be read."""

    def __init__(self, left: int) -> None:
        self.left = left

    def spend(self) -> None:
        """Use one, or raise a `BudgetError` if none is left."""
        self.left -= 1
        if self.left < 0:
            raise BudgetError("more fields than the limit")


def fields(message: memoryview, budget: Budget) -> Iterator[Field]:
    """The fields of a message, in order. All messages of a file share a budget.

    Raises:
      WireError: the message is truncated, a number is not in its shortest form or exceeds 64 bits,
        or a type or field number does not exist.
      BudgetError: too many fields.
    """
    at, end = 0, len(message)
    while at < end:
        budget.spend()
        tag, at = _varint(message, at)
        number, type = tag >> 3, tag & 7
        if not 1 <= number <= _MAX_FIELD:
            raise WireError(f"field number {number}")
        if type == VARINT:
            value, at = _varint(message, at)
            yield number, type, value
            continue
        if type == LENGTH:
            length, at = _varint(message, at)
        elif type in _FIXED_BYTES:
            length = _FIXED_BYTES[type]
        else:
            raise WireError(f"wire type {type} in field {number}")
        if length > end - at:
            raise WireError(f"field {number} ends {length - (end - at)} bytes after its message")
        yield number, type, message[at : at + length]
        at += length


def varints(packed: memoryview, budget: Budget) -> Iterator[int]:
    """Packed varints, each in [0, 2⁶⁴). It raises what `fields` raises."""
    at = 0
    while at < len(packed):
        budget.spend()
        value, at = _varint(packed, at)
        yield value


def encoded(number: int, value: int | bytes | memoryview) -> bytes:
    """A field: a number in [0, 2⁶⁴), or text, bytes or a message."""
    if isinstance(value, int):
        return _encoded_varint(number << 3 | VARINT) + _encoded_varint(value)
    return _encoded_varint(number << 3 | LENGTH) + _encoded_varint(len(value)) + bytes(value)


def _encoded_varint(value: int) -> bytes:
    low = bytearray()
    while value >= 0x80:
        low.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*low, value])


def signed(value: int) -> int:
    """The int64 that a varint represents."""
    return value - 2**64 if value >= 2**63 else value


def _varint(view: memoryview, at: int) -> tuple[int, int]:
    """The varint at a position, and the position after it."""
    if at < len(view) and view[at] < 0x80:  # the usual case
        return view[at], at + 1
    value = 0
    for shift, byte in zip(range(0, 70, 7), view[at : at + 10], strict=False):
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            if value >= 2**64 or (byte == 0 and shift > 0):
                raise WireError("a number that exceeds 64 bits or is not in its shortest form")
            return value, at + shift // 7 + 1
    raise WireError("a number that does not end")
