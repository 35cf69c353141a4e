"""The walker over protocol buffers: what it reads, and what it refuses to read."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import AttributeProto

from leaderboard.artefact.wire import (
    FIXED32,
    LENGTH,
    VARINT,
    Budget,
    BudgetError,
    WireError,
    fields,
    signed,
    varints,
)


def read(data, budget=1000):
    return [
        (number, type, bytes(value) if isinstance(value, memoryview) else value)
        for number, type, value in fields(memoryview(data), Budget(budget))
    ]


@given(st.integers(-(2**63), 2**63 - 1), st.text(), st.lists(st.floats(width=32), max_size=5))
def test_it_reads_messages_of_googles_library(i, name, floats):
    message = AttributeProto(name=name, i=i, floats=floats)
    found = read(message.SerializeToString())
    assert [(number, type) for number, type, _ in found] == [
        (1, LENGTH), (3, VARINT), *[(7, FIXED32)] * len(floats)
    ]  # fmt: skip
    assert found[0][2] == name.encode()
    assert signed(found[1][2]) == i


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\x08", "does not end"),
        (b"\x08\x80", "does not end"),
        (b"\x08" + b"\xff" * 9 + b"\x02", "exceeds 64 bits"),
        (b"\x08" + b"\xff" * 10 + b"\x01", "does not end"),
        (b"\x08\x80\x00", "not in its shortest form"),
        (b"\x88\x00\x01", "not in its shortest form"),
        (b"\x0a\x05abcd", "field 1 ends 1 bytes after"),
        (b"\x0a\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01", "ends .* bytes after its message"),
        (b"\x0d\x00\x00\x00", "field 1 ends 1 bytes after"),
        (b"\x09\x00", "field 1 ends 7 bytes after"),
        (b"\x00\x01", "field number 0"),
        (b"\x80\x80\x80\x80\x10\x01", "field number 536870912"),
        (b"\x0b\x0c", "wire type 3"),
        (b"\x0c", "wire type 4"),
        (b"\x0e", "wire type 6"),
        (b"\x0f", "wire type 7"),
    ],
)
def test_invalid_messages_are_rejected(data, message):
    with pytest.raises(WireError, match=message):
        read(data)


@given(st.binary(max_size=64))
def test_any_bytes_are_read_or_rejected(data):
    try:
        read(data)
    except WireError:
        return


def test_every_field_costs_one_of_the_budget():
    data = b"\x08\x01" * 10
    assert len(read(data, budget=10)) == 10
    with pytest.raises(BudgetError):
        read(data, budget=9)


def test_packed_numbers_cost_of_the_same_budget():
    packed = memoryview(b"\x01\xff\x01\x00")
    assert list(varints(packed, Budget(3))) == [1, 255, 0]
    with pytest.raises(BudgetError):
        list(varints(packed, Budget(2)))
    with pytest.raises(WireError, match="does not end"):
        list(varints(memoryview(b"\x01\x80"), Budget(9)))


def test_values_are_views_of_the_bytes_and_no_copies():
    data = b"\x0a\x80\x80\x40" + bytes(2**20)
    ((_, _, value),) = fields(memoryview(data), Budget(1))
    assert isinstance(value, memoryview)
    assert value.obj is data
