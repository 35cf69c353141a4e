"""Tickets without a server: what is refused, what survives, and what a restart changes."""

from __future__ import annotations

import contextlib
import datetime
import errno
import os
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from leaderboard.documents.entry import SignedTicketRequest
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.master import Master
from leaderboard.documents.submission import Envelope
from leaderboard.errors import BoardError, Rejection
from leaderboard.intake import start_ticket
from leaderboard.scoring.sealed import instances
from leaderboard.sealed import Tickets
from leaderboard.sealed import tickets as tickets_module
from leaderboard.sealed.attendant import Attendant, _score
from leaderboard.sealed.instance import SteppedInstance
from leaderboard.sealed.scores import score_ticket
from leaderboard.sealed.stepping import Lanes
from leaderboard.sealed.ticket import RunningTicket
from leaderboard.sealed.tickets import Clock
from leaderboard.store import Store, played_bytes
from leaderboard.store.files import to_bytes
from sme_registry.io import sha256_of
from sme_registry.sealed import Statement, StepFormat, pack_table, unpack_table
from tests.leaderboard.conftest import tiny_board
from tests.leaderboard.sealed.playing import Board, online_board
from tests.leaderboard.sealing import MASTER, NOTHING, SETTING, moment, tiny_season

LANES = 4
WIRE = StepFormat(LANES, 2, 1)
KEY = SigningKey.generate()
ROWS = 6 * 50


class Played:
    """A board whose season is stepped in this process, and one ticket of it."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self.store = Store.open(board.path)
        self.request = board.request(KEY)
        envelope = Envelope.read(self.request.to_bytes(), SignedTicketRequest)
        self.number, _ = start_ticket(self.store, envelope, board.season.digest)
        self.open()
        self.token = self.tickets.ticket(self.number).document.token

    def open(self) -> None:
        self.tickets = Tickets(self.store, self.board.secret)

    def restart(self) -> None:
        """As after a kill: nothing but the files is left."""
        self.tickets.close()
        self.open()

    def start(self, lanes: int = LANES, instance: int = 0) -> bytes:
        return self.tickets.start(self.number, self.token, instance, lanes)

    def step(self, number: int, value: float = 0.3, instance: int = 0) -> bytes:
        body = WIRE.pack_request(number, np.full((LANES, 1), value, np.float32))
        return self.tickets.step(self.number, self.token, instance, body)

    def finish(self, instance: int = 0) -> None:
        self.tickets.finish(self.number, self.token, instance)

    def answer(self, table: Any, instance: int = 0) -> bool:
        data = table if isinstance(table, bytes) else pack_table(table)
        journal = NOTHING
        with contextlib.suppress(Rejection):  # as long as steps may follow
            journal = self.tickets.journal_digest(self.number, self.token, instance)
        signature = self.signature(data, journal, instance)
        return self.tickets.answer(self.number, self.token, instance, data, signature)

    def signature(self, data: bytes, journal: str, instance: int = 0) -> str:
        """The entrant's, of these answers and this digest of the steps."""
        signer = self.request.signer(KEY)
        assert signer is not None
        statement = Statement(
            request=self.request.id,
            ticket=self.number,
            instance=instance,
            answers=sha256_of(data),
            journal=journal,
        )
        return signer.sign(statement)

    @property
    def used(self) -> int:
        return self.tickets.status(self.number, self.token).instances[0].used


@pytest.fixture
def played(tmp_path: Path) -> Iterator[Played]:
    ready = Played(online_board(tmp_path))
    yield ready
    ready.tickets.close()
    ready.store.close()


def refused(code: str, *arguments: Any, **others: Any) -> str:
    """The message of a refusal with this code."""
    call, *rest = arguments
    with pytest.raises(Rejection) as caught:
        call(*rest, **others)
    assert caught.value.code == code
    return caught.value.message


def test_a_restart_changes_no_answer(played: Played) -> None:
    played.start()
    answers = [played.step(number, number / 10) for number in range(1, 6)]
    played.restart()
    begun = WIRE.unpack_begun(played.start())
    assert begun.number == 5
    np.testing.assert_array_equal(begun.observation, WIRE.unpack_steps(answers[-1]).observation)
    assert played.step(5, 0.5) == answers[-1]
    following = played.step(6)
    played.restart()
    assert played.step(6) == following  # without a start
    assert played.used == 6 * LANES


def test_the_same_steps_cost_once_and_others_are_refused(played: Played) -> None:
    played.start()
    first = played.step(1)
    assert played.step(1) == first
    refused("step_conflict", played.step, 1, 0.4)
    second = played.step(2)
    refused("step_conflict", played.step, 1)
    refused("step_ahead", played.step, 4)
    refused("step_conflict", played.step, 0)
    assert played.step(2) == second
    assert played.used == 2 * LANES


def test_the_budget_is_exact(played: Played) -> None:
    played.start(lanes=4)
    for number in range(1, 17):
        last = played.step(number)
    assert played.used == 64
    for _ in range(2):
        assert played.step(16) == last
        refused("budget_spent", played.step, 17)
        played.restart()
    assert played.tickets.status(played.number, played.token).instances[0].phase == "answering"


def test_lanes_that_do_not_divide_the_budget_leave_a_rest(played: Played) -> None:
    wire = StepFormat(48, 2, 1)
    played.start(lanes=48)
    body = wire.pack_request(1, np.zeros((48, 1)))
    played.tickets.step(played.number, played.token, 0, body)
    body = wire.pack_request(2, np.zeros((48, 1)))
    refused("budget_spent", played.tickets.step, played.number, played.token, 0, body)
    assert played.tickets.status(played.number, played.token).instances[0].phase == "answering"


@pytest.mark.parametrize("lanes", [0, 65, 2**40])
def test_lanes_have_a_range(played: Played, lanes: int) -> None:
    refused("lanes_invalid", played.start, lanes)


def test_a_large_budget_has_no_more_than_256_lanes(tmp_path: Path) -> None:
    member = {"name": "deep", "setting": SETTING, "instances": 1, "budget": 1000}
    played = Played(online_board(tmp_path, classes=[member]))
    refused("lanes_invalid", played.start, 257)
    played.start(256)
    played.tickets.close()
    played.store.close()


def test_an_instance_keeps_its_lanes(played: Played) -> None:
    played.start(4)
    refused("start_conflict", played.start, 5)
    played.restart()
    refused("start_conflict", played.start, 5)
    played.start(4)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_actions_must_be_finite(played: Played, value: float) -> None:
    played.start()
    refused("step_invalid", played.step, 1, value)
    assert played.used == 0


def test_actions_outside_the_cube_are_clipped(played: Played) -> None:
    played.start()
    played.start(instance=1)
    high = played.step(1, 7.0)
    played.restart()
    assert played.step(1, 7.0) == high
    assert played.used == LANES


@pytest.mark.parametrize("size", [0, 7, 8, WIRE.request_bytes - 1, WIRE.request_bytes + 1])
def test_a_step_has_one_size(played: Played, size: int) -> None:
    played.start()
    refused(
        "step_invalid", played.tickets.step, played.number, played.token, 0, b"\1" + bytes(size)[1:]
    )
    assert played.used == 0


def test_phases_follow_each_other(played: Played) -> None:
    half = np.full((ROWS, 1), 0.5, np.float32)
    refused("instance_phase", played.step, 1)
    refused("instance_phase", played.tickets.challenge, played.number, played.token, 0)
    refused("instance_phase", played.answer, half)
    played.start()
    played.step(1)
    refused("instance_phase", played.tickets.challenge, played.number, played.token, 0)
    refused("instance_phase", played.answer, half)
    played.finish()
    played.finish()
    refused("instance_phase", played.step, 2)
    played.restart()
    refused("instance_phase", played.step, 2)
    states = unpack_table(played.tickets.challenge(played.number, played.token, 0), 4)
    assert len(states) == ROWS
    assert played.answer(half)
    assert not played.answer(half)
    refused("answer_conflict", played.answer, half * 0.5)
    played.restart()
    assert not played.answer(half)
    refused("instance_phase", played.start)
    refused("instance_phase", played.step, 2)
    played.finish()


@pytest.mark.parametrize(
    ("table", "code"),
    [
        (np.full((ROWS - 1, 1), 0.5), "answer_shape"),
        (np.full((ROWS, 2), 0.5), "answer_shape"),
        (np.full((ROWS, 1), np.nan), "answer_not_finite"),
        (b"", "answer_shape"),
        (pickle.dumps(np.full((ROWS, 1), 0.5)), "answer_shape"),
        (pack_table(np.full((ROWS, 1), 0.5)) + b"\0", "answer_shape"),
    ],
)
def test_answers_have_one_form(played: Played, table: Any, code: str) -> None:
    played.finish()
    refused(code, played.answer, table)
    assert played.answer(np.full((ROWS, 1), 0.5))


def test_answers_need_a_signature_of_them_and_the_journal(played: Played) -> None:
    played.start()
    played.step(1)
    played.finish()
    data = pack_table(np.full((ROWS, 1), 0.5))
    instance = played.tickets.ticket(played.number).instance(0)
    journal = instance.journal_digest()
    body = WIRE.pack_request(1, np.full((LANES, 1), 0.3, np.float32))
    assert journal == sha256_of(body)
    others = [
        "",
        "0" * 128,
        played.signature(data + b"x", journal),
        played.signature(data, NOTHING),
        played.signature(data, journal, instance=1),
        KEY.sign("answers", played.request.id, played.request.board),
    ]
    for other in others:
        refused("bad_signature", instance.answer, data, other)
    assert not instance.answered
    assert instance.answer(data, played.signature(data, journal))
    assert instance.is_signed


def test_requests_older_than_signed_answers_need_no_signature(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    with Store.open(board.path) as store:
        request = board.request(KEY, answers_key=None)
        assert "answers_key" not in request.to_dict()["ticket"]
        number = store.start_ticket(request)
        tickets = Tickets(store, board.secret)
        instance = tickets.ticket(number).instance(0)
        instance.finish()
        assert instance.answer(pack_table(np.full((ROWS, 1), 0.5)), "")
        assert instance.is_signed
        result = score_ticket(store, board.season, Master.read(board.secret), number)
        tickets.close()
    assert "signed" not in result.to_dict()["stepping"][0]


def test_a_token_opens_one_ticket(played: Played) -> None:
    request = Envelope.read(played.board.request(KEY, 1).to_bytes(), SignedTicketRequest)
    other, _ = start_ticket(played.store, request, played.board.season.digest)
    for number, token in ((other, played.token), (played.number, ""), (played.number, "é")):
        tickets = played.tickets
        refused("token_wrong", tickets.start, number, token, 0, 1)
        refused("token_wrong", tickets.status, number, token)
        refused("token_wrong", tickets.answer_bytes, number, token, 0)
        refused("token_wrong", tickets.journal_digest, number, token, 0)
        refused(
            "token_wrong", tickets.answer, number, token, 0, pack_table(np.zeros((ROWS, 1))), ""
        )
    refused("ticket_unknown", played.tickets.start, 99, played.token, 0, 1)
    refused("instance_unknown", played.tickets.start, played.number, played.token, 2, 1)


def test_no_two_tickets_share_a_task(played: Played) -> None:
    seeds = set()
    for ticket in ("1", "2"):
        for nonce in ("0" * 64, "1" * 64):
            master = Master.read(played.board.secret)
            seeds |= {
                each.spec.seed for each in instances(played.board.season, master, ticket, nonce)
            }
    assert len(seeds) == 8


def test_a_deadline_ends_everything(played: Played, monkeypatch: pytest.MonkeyPatch) -> None:
    played.start()
    played.step(1)
    assert played.tickets.over() == []
    clock = tickets_module.time.time
    monkeypatch.setattr(tickets_module.time, "time", lambda: clock() + 23.9 * 3600)
    played.step(2)
    monkeypatch.setattr(tickets_module.time, "time", lambda: clock() + 24.1 * 3600)
    refused("ticket_ended", played.step, 3)
    refused("ticket_ended", played.start)
    refused("ticket_ended", played.finish)
    refused("ticket_ended", played.answer, np.full((ROWS, 1), 0.5))
    assert played.tickets.status(played.number, played.token).phase == "ended"


def test_a_ticket_is_over_when_its_last_instance_is_answered(played: Played) -> None:
    for instance, over in ((0, []), (1, [played.number])):
        played.finish(instance)
        played.answer(np.full((ROWS, 1), 0.5), instance)
        assert played.tickets.over() == over
        phase = played.tickets.status(played.number, played.token).phase
        assert phase == ("ended" if over else "running")


def test_an_altered_request_holds_up_no_other_ticket(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    second = played.board.request(KEY, 1)
    played.store.start_ticket(second)
    folder = played.store.season_folder(played.board.season.digest)
    folder.request(played.number).write_bytes(second.to_bytes())
    clock = tickets_module.time.time
    monkeypatch.setattr(tickets_module.time, "time", lambda: clock() + 25 * 3600)
    played.restart()
    assert played.tickets.over() == [2]


def test_a_clock_set_forward_ends_tickets_after_a_minute(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    uptime, clock = tickets_module.time.monotonic, tickets_module.time.time

    def over(hours: float, passed: float) -> list[int]:
        monkeypatch.setattr(tickets_module.time, "monotonic", lambda: uptime() + passed)
        monkeypatch.setattr(tickets_module.time, "time", lambda: clock() + hours * 3600 + passed)
        return played.tickets.over()

    looks = ((25, 0.0), (25, 50.0), (0, 60.0), (25, 70.0), (25, 129.0))
    assert [over(*look) for look in looks] == [[]] * 5
    assert over(25, 131.0) == [played.number]


def test_a_clock_set_back_extends_no_deadline(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    played.start()
    uptime, clock = tickets_module.time.monotonic, tickets_module.time.time
    monkeypatch.setattr(tickets_module.time, "monotonic", lambda: uptime() + 25 * 3600)
    monkeypatch.setattr(tickets_module.time, "time", lambda: clock() - 3600)
    refused("ticket_ended", played.step, 1)


def test_the_clock_of_a_server_begins_no_earlier_than_the_log() -> None:
    start = moment(2)
    clock, expected = Clock(start), datetime.datetime.fromisoformat(start).timestamp()
    assert clock.now >= expected
    assert clock.sure >= expected


def test_a_closed_ticket_takes_nothing_from_requests_in_progress(played: Played) -> None:
    played.start(instance=1)
    instance, other = played.tickets.ticket(played.number).instances
    played.finish()
    played.tickets.close_ticket(played.number)
    refused("ticket_ended", instance.answer, pack_table(np.full((ROWS, 1), 0.5)), "")
    assert not instance.answered
    refused("ticket_ended", other.start, LANES)
    refused("ticket_ended", other.step, WIRE.pack_request(1, np.zeros((LANES, 1))))
    refused("ticket_ended", other.finish)


def test_steps_that_arrive_while_an_unplayed_ticket_is_closed_are_scored(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    def late(ticket: RunningTicket) -> None:
        ticket.instance(0).start(LANES)
        ticket.instance(0).step(WIRE.pack_request(1, np.zeros((LANES, 1))))
        close(ticket)

    close = RunningTicket.close
    monkeypatch.setattr(RunningTicket, "close", late)
    assert played.tickets.end_unplayed([played.number], 100) == []
    assert played.store.ticket(played.board.season.digest, played.number).result is None


def test_a_ticket_takes_nothing_while_it_is_scored_and_what_it_took_is_flushed(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    played.start()
    played.step(1)
    flushed: list[int] = []
    monkeypatch.setattr(os, "fdatasync", flushed.append)
    attendant = Attendant(played.tickets)
    attendant.attend()
    assert len(flushed) == 1
    clock = tickets_module.time.time
    monkeypatch.setattr(tickets_module.time, "time", lambda: clock() + 25 * 3600)
    played.restart()
    monkeypatch.setattr(Attendant, "_start", lambda _: None)
    Attendant(played.tickets).attend()
    instance = played.tickets.ticket(played.number).instance(0)
    refused("ticket_ended", instance.step, WIRE.pack_request(2, np.zeros((LANES, 1))))


class Failed:
    """A process that has ended in vain."""

    exitcode = 1

    def is_alive(self) -> bool:
        return False

    def close(self) -> None:
        pass


def test_tickets_that_could_not_be_scored_are_tried_again_after_a_pause_one_by_one(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    played.store.start_ticket(played.board.request(KEY, 1))
    for number in (1, 2):
        instance = played.tickets.ticket(number).instance(0)
        instance.start(LANES)
        instance.step(WIRE.pack_request(1, np.zeros((LANES, 1))))
    clock, uptime = tickets_module.time.time, tickets_module.time.monotonic
    monkeypatch.setattr(tickets_module.time, "time", lambda: clock() + 25 * 3600)
    played.restart()
    started: list[list[int]] = []

    def start(attendant: Attendant) -> Failed:
        started.append(attendant._numbers)
        return Failed()

    monkeypatch.setattr(Attendant, "_start", start)
    attendant = Attendant(played.tickets)
    attendant.attend()
    attendant.attend()
    assert started == [[1, 2]]
    monkeypatch.setattr(tickets_module.time, "monotonic", lambda: uptime() + 2)
    for _ in range(3):
        attendant.attend()
    assert started == [[1, 2], [1], [2]]
    attendant.attend()
    assert len(started) == 3


@pytest.mark.parametrize("fault", [False, True])
def test_a_process_says_whether_all_tickets_were_scored(
    played: Played, monkeypatch: pytest.MonkeyPatch, fault: bool
) -> None:
    played.start()
    played.step(1)
    played.tickets.close()
    board, season = played.board, played.board.season
    if fault:
        folder = played.store.season_folder(season.digest).ticket(played.number)
        (folder / "0.journal").write_bytes(b"no journal")
    monkeypatch.setattr("leaderboard.sealed.attendant.signal.signal", lambda *_: None)
    with pytest.raises(SystemExit) as end:
        _score(board.path, season.digest, board.secret, [played.number])
    assert bool(end.value.code) is fault
    row = played.store.ticket(season.digest, played.number)
    assert (row.result is None) is fault


def test_a_disk_that_fails_for_a_moment_ends_no_server(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    played.start()
    played.step(1)

    def fails(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fdatasync", fails)
    played.tickets.sync()


def test_a_full_disk_costs_no_step(played: Played, monkeypatch: pytest.MonkeyPatch) -> None:
    played.start()
    first = played.step(1)

    def full(handle: int, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    message = refused("storage_full", played.step, 2)
    assert "No space left on device" in message
    monkeypatch.undo()
    assert played.step(1) == first
    assert played.used == LANES
    played.step(2)


@pytest.mark.parametrize("lanes", [1, LANES])
def test_journals_and_answers_count_on_the_board(tmp_path: Path, lanes: int) -> None:
    fields = {"name": "deep", "setting": SETTING, "instances": 1, "budget": 1024}
    played = Played(online_board(tmp_path, classes=[fields]))
    wire = StepFormat(lanes, 2, 1)
    played.start(lanes)
    for number in range(1, 1024 // lanes):  # the budget, but for its last request
        body = wire.pack_request(number, np.ones((lanes, 1), np.float32))
        played.tickets.step(played.number, played.token, 0, body)
    played.finish()
    played.answer(np.full((ROWS, 1), 0.5))

    def written() -> int:
        files = played.board.path.glob("seasons/*/tickets/1/0.*")
        return sum(path.stat().st_size for path in files)

    def counted() -> int:
        return played.store.total_bytes() - len(played.request.to_bytes())

    assert 4 * 1000 < written() <= counted() == played_bytes(played.board.season)
    result = score_ticket(played.store, played.board.season, MASTER, 1)
    played.store.end_ticket(played.board.season.digest, 1, result)
    assert written() < counted() < played_bytes(played.board.season) + len(to_bytes(result))
    assert played_bytes(played.board.season, result) >= written()


def test_no_ticket_starts_without_room_for_its_steps(tmp_path: Path) -> None:
    fields = {"name": "deep", "setting": SETTING, "instances": 2, "budget": 4096}
    room = played_bytes(tiny_season("sealed-online", classes=[fields])) * 3 // 2
    played = Played(online_board(tmp_path, limits={"total_bytes": room}, classes=[fields]))
    second = Envelope.read(played.board.request(KEY, 1).to_bytes(), SignedTicketRequest)
    refused("quota", start_ticket, played.store, second, played.board.season.digest)
    assert len(played.store.entrants(played.board.season.digest)) == 1
    played.start()
    for number in range(1, 64 // LANES + 1):
        played.step(number)
    result = score_ticket(played.store, played.board.season, MASTER, 1)
    played.store.end_ticket(played.board.season.digest, 1, result)
    assert start_ticket(played.store, second, played.board.season.digest) == (2, True)


def test_answers_that_do_not_fit_the_disk_are_not_stored(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    played.finish()

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "link", full)
    half = np.full((ROWS, 1), 0.5)
    refused("storage_full", played.answer, half)
    monkeypatch.undo()
    played.restart()
    assert played.tickets.status(played.number, played.token).instances[0].phase == "answering"
    assert played.answer(half)


def test_a_step_that_fails_after_it_was_recorded_is_answered_when_it_is_sent_again(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    played.start()
    played.step(1)

    def fails(*_: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(Lanes, "step", fails)
    with pytest.raises(MemoryError):
        played.step(2)
    monkeypatch.undo()
    answers = [played.step(2), played.step(3)]
    played.restart()
    assert played.step(3) == answers[1]
    assert played.used == 3 * LANES
    assert np.isfinite(WIRE.unpack_steps(answers[0]).observation).all()


def test_answers_whose_folder_could_not_be_synced_are_confirmed_when_they_are_sent_again(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    played.finish()

    def fails(_: Path) -> None:
        raise OSError(errno.EIO, "Input/output error")

    half = np.full((ROWS, 1), 0.5)
    monkeypatch.setattr("leaderboard.sealed.instance.io.sync_folder", fails)
    for _ in range(2):
        refused("storage_full", played.answer, half)
    monkeypatch.undo()
    assert not played.answer(half)
    assert played.tickets.ticket(played.number).instance(0).answered


def test_large_networks_take_more_memory_and_no_time_of_the_event_loop(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SteppedInstance, "weights", 2**20)
    monkeypatch.setattr(tickets_module, "MOST_HELD_LANES", 2**21 // 100)
    played.start()
    assert played.tickets.ticket(played.number).instance(0).is_ready
    played.start(instance=1)
    ticket = played.tickets.ticket(played.number)
    assert [each.is_ready for each in ticket.instances] == [False, True]
    monkeypatch.setattr(SteppedInstance, "weights", 2**22)
    assert not ticket.instance(1).is_ready


def test_instances_used_long_ago_leave_memory_and_go_on(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tickets_module, "MOST_HELD_LANES", 150)
    played.start()
    first = [played.step(1, 0.2), played.step(2, 0.9)]
    played.start(instance=1)
    ticket = played.tickets.ticket(played.number)
    assert not ticket.instance(0).is_ready
    assert ticket.instance(1).is_ready
    assert played.step(2, 0.9) == first[1]
    assert not ticket.instance(1).is_ready


def test_one_server_steps_a_season(played: Played) -> None:
    with pytest.raises(BoardError, match="another server steps it"):
        Tickets(played.store, played.board.secret)


def test_a_master_must_be_that_of_a_season(played: Played, tmp_path: Path) -> None:
    other = Master.generate().write(tmp_path / "other.master")
    with pytest.raises(BoardError, match="the master of no sealed-online season"):
        Tickets(played.store, other)
    with tiny_board(tmp_path / "offline") as store:
        store.announce(tiny_season("sealed-offline"))
        with pytest.raises(BoardError, match="the master of no sealed-online season"):
            Tickets(store, played.board.secret)


def test_what_was_not_answered_scores_one(played: Played) -> None:
    played.start()
    played.step(1)
    played.finish()
    hidden = next(instances(played.board.season, Master.read(played.board.secret), "1", "0" * 64))
    states = unpack_table(played.tickets.challenge(played.number, played.token, 0), 4)
    from sme_registry import materialize

    best = materialize(hidden.spec).optimal_action(states[:, :2])
    played.answer(best)
    result = score_ticket(
        played.store, played.board.season, Master.read(played.board.secret), played.number
    )
    assert result.runs[0].wd_regret < 1e-6
    assert result.runs[1].wd_regret == result.runs[1].ood_decay == 1.0
    assert [each.steps for each in result.stepping] == [LANES, 0]
    assert result.stepping[1].normalised_online_regret == 1.0
    assert all(run.spec is run.evaluation_seed is None for run in result.runs)
    assert played.store.end_ticket(played.board.season.digest, played.number, result)
    assert not played.store.end_ticket(played.board.season.digest, played.number, result)
    played.restart()
    refused("ticket_ended", played.start)
