"""The messages of sealed-online seasons: what is sent arrives, and nothing else is read."""

import io
import os

import numpy as np
import pytest

from sme_registry.errors import OptionError, SpecError, WireError
from sme_registry.seasons import Ticket
from sme_registry.seasons.wire import (
    StepFormat,
    StepsAnswer,
    instance_path,
    pack_table,
    table_bytes,
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


def test_an_address_has_the_season_the_ticket_and_the_instance():
    path = instance_path("winter", 7, 3, "steps")
    assert path == "/api/seasons/winter/tickets/7/instances/3/steps"


def test_the_answer_to_start_arrives_and_has_one_size():
    data = FORMAT.pack(2**40, random(LANES, S + 2))
    number, observation = FORMAT.unpack_start(data)
    assert number == 2**40
    assert np.array_equal(observation, random(LANES, S + 2))
    for other in (b"", data[:-4], data + bytes(4 * LANES)):
        with pytest.raises(WireError, match="start: has"):
            FORMAT.unpack_start(other)


def test_the_bytes_of_a_request_are_little_endian():
    body = StepFormat(1, S, 1).pack(1, np.array([[0.5]]))
    assert body == b"\1\0\0\0\0\0\0\0\0\0\0\x3f"


def steps(terminated, truncated):
    return StepsAnswer(
        random(LANES, S + 2), random(LANES), np.array(terminated), np.array(truncated),
        random(LANES, S + 2)[::-1],
    )  # fmt: skip


@pytest.mark.parametrize("ends", [([True, False, True], [False, True, True]), ([False] * 3,) * 2])
def test_steps_arrive_with_every_kind_of_end_in_one_size(ends):
    sent = steps(*ends)
    data = FORMAT.pack_steps(sent)
    assert len(data) == FORMAT.answer_bytes == 4 * LANES * (2 * (S + 2) + 2)
    for given, arrived in zip(sent, FORMAT.unpack_steps(data), strict=True):
        assert np.array_equal(given, arrived)
        assert given.dtype == arrived.dtype
        assert arrived.flags.writeable


def test_ends_that_do_not_exist_are_refused():
    table = np.zeros((LANES, 2 * (S + 2) + 2), "<f4")
    for ends in (4.0, 0.5, -1.0, np.nan):
        table[1, S + 3] = ends
        with pytest.raises(WireError, match="must be 0, 1, 2 or 3"):
            FORMAT.unpack_steps(table.tobytes())


@pytest.mark.parametrize("rows", [0, 1, 1000, 123456])
def test_a_table_is_the_file_that_numpy_reads_and_writes(rows):
    table = random(rows, A)
    assert np.array_equal(np.load(io.BytesIO(pack_table(table)), allow_pickle=False), table)
    assert len(pack_table(table)) <= table_bytes(rows, A)
    for data in (pack_table(table), saved(table)):
        assert np.array_equal(unpack_table(data, A, rows), table)


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
