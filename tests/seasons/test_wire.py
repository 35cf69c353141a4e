"""The messages of sealed-online seasons: what is sent arrives, and nothing else is read."""

import io
import os

import numpy as np
import pytest

from sme_registry.errors import OptionError, SpecError, WireError
from sme_registry.seasons import Ticket
from sme_registry.seasons.wire import (
    StepFormat,
    pack_table,
    unpack_table,
)

LANES, S, A = 3, 5, 2
FORMAT = StepFormat(LANES, S, A)
TICKET = {
    "season": "winter",
    "ticket": 7,
    "token": "ab" * 32,
    "deadline": "2026-12-01T00:00:00Z",
    "lanes": 256,
    "classes": [
        {"name": "deep", "setting": {"complexity": 5}, "instances": 2, "budget": 1000},
        {"name": "wide", "setting": {"complexity": 6}, "instances": 1, "budget": 500},
    ],
}


def random(*shape):
    return np.random.default_rng(0).random(shape, dtype=np.float32)


def saved(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def test_the_bytes_of_a_request_are_little_endian():
    body = StepFormat(1, S, 1).pack(1, np.array([[0.5]]))
    assert body == b"\1\0\0\0\0\0\0\0\0\0\0\x3f"


def test_ends_that_do_not_exist_are_refused():
    table = np.zeros((LANES, 2 * (S + 2) + 2), "<f4")
    for ends in (4.0, 0.5, -1.0, np.nan):
        table[1, S + 3] = ends
        with pytest.raises(WireError, match="must be 0, 1, 2 or 3"):
            FORMAT.unpack_steps(table.tobytes())


def other_header(shape):
    data = pack_table(random(4, A))
    return data.replace(f"({4}, {A})".encode(), shape.encode())


def long_header():
    """Valid, but longer than `table_bytes` allows for."""
    header, data = pack_table(random(4, A)).split(b"\n", 1)
    header = header[10:].ljust(2000) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x93NUMPY",
        saved(random(4, A).astype(np.float64)),
        saved(np.asfortranarray(random(4, A))),
        saved(random(4 * A)),
        saved(np.array([{"code": 1}, None], dtype=object)),
        pack_table(random(4, A)).replace(b"\x01\x00", b"\x02\x00", 1),
        other_header("(-4, 2)"),
        long_header(),
    ],
)
def test_nothing_but_a_table_of_float32_is_read(data):
    with pytest.raises(WireError, match=r"must be an \.npy file"):
        unpack_table(data, A)


def test_a_ticket_counts_its_instances_class_by_class_and_hides_its_token():
    ticket = Ticket.from_dict(TICKET)
    assert [(place.member.name, place.instance) for place in ticket.places] == [
        ("deep", 0), ("deep", 1), ("wide", 0),
    ]  # fmt: skip
    assert ticket.place(2).member.budget == 500
    with pytest.raises(OptionError, match=r"instance=3: must be an integer in \[0, 2\]"):
        ticket.place(3)
    assert TICKET["token"] not in repr(ticket)


def test_a_ticket_s_file_is_its_owner_s_alone_and_is_not_replaced(tmp_path):
    ticket, path = Ticket.from_dict(TICKET), tmp_path / "new" / "ticket.json"
    with pytest.raises(SpecError, match=r"ticket\.json"):
        Ticket.read(path)
    assert ticket.write(path) == path
    assert Ticket.read(path) == ticket
    assert os.stat(path).st_mode & 0o777 == 0o600
    with pytest.raises(OptionError, match="already exists"):
        ticket.write(path)
    assert [each.name for each in path.parent.iterdir()] == ["ticket.json"]
