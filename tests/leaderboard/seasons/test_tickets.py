"""Sessions without a server: what is refused, what survives, and what a restart changes."""

import errno
import os
import pickle

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from leaderboard.documents.signed import Signed
from leaderboard.errors import BoardError, Rejection
from leaderboard.scoring.worker import Work, run_scorer
from leaderboard.seasons import tickets as tickets_module
from leaderboard.seasons.instance import Instance
from leaderboard.seasons.journal import Journal, Play, played_bytes
from leaderboard.seasons.season import Master, TicketRequest
from leaderboard.seasons.store import SeasonStore
from leaderboard.seasons.tickets import ScoreTicket, Sessions, start_ticket
from leaderboard.store.log import to_bytes
from sme_registry import materialize
from sme_registry.seasons.wire import pack_table, unpack_table
from tests.leaderboard.clocks import set_clocks
from tests.leaderboard.conftest import tiny_board
from tests.leaderboard.seasons.playing import LANES, ROWS, online_board, playing, request, scored
from tests.leaderboard.seasons.sealing import SETTING, tiny_season

HALF = np.full((ROWS, 1), 0.5, np.float32)


@pytest.fixture
def played(tmp_path):
    with playing(online_board(tmp_path)) as ready:
        yield ready


def fails(number):
    """A call of the system that fails."""

    def call(*_, **__):
        raise OSError(number, os.strerror(number))

    return call


def refused(code, call, *arguments, **named):
    """The message of a refusal with this code."""
    with pytest.raises(Rejection) as caught:
        call(*arguments, **named)
    assert caught.value.code == code
    return caught.value.message


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """A board on which one key may take many tickets."""
    folder, fields = tmp_path_factory.mktemp("many"), {"tickets": 1000, "tickets_per_key": 1000}
    with (
        pytest.MonkeyPatch.context() as patch,
        playing(online_board(folder, {"submissions_per_day": 1000}, **fields)) as ready,
    ):
        patch.setattr("leaderboard.seasons.instance.EVERY", 3)
        yield ready


EVENTS = ("step", "again", "other", "ahead", "start", "restart", "kill", "release")
FAULTS = ("full disk", "no memory")


@settings(max_examples=25)
@given(
    events=st.lists(st.sampled_from(("step", *EVENTS, *FAULTS)), min_size=5, max_size=30),
    lanes=st.sampled_from([4, 20, 48]),
)
@example(events=["step", "step", "kill", "again", "step", "step", "kill", "step"], lanes=4)
@example(events=["step", "restart", "again", "full disk", "no memory", "again"], lanes=4)
@example(events=[*["step"] * 17, "again", "restart", "again", "step"], lanes=4)
def test_each_step_is_taken_once_whatever_happens(many, events, lanes):
    many.take_ticket(many.number)
    hidden = many.ticket.hidden(0)
    here = Play(hidden.spec, hidden.starts, many.chain(0), lanes, 64)
    taken, last, most = 0, b"", 64 // lanes
    many.start(lanes)
    for event in events:
        level = 0.03 * (taken + 1)
        if event == "restart":
            many.restart()
        elif event == "kill":
            many.kill()
        elif event == "release":
            many.ticket.instance(0).release()
        elif event == "start":
            assert many.start(lanes) == here.started
        elif event == "again":
            if taken:
                assert many.step(taken, 0.03 * taken, lanes=lanes) == last
        elif event == "other":
            refused("step_conflict", many.step, taken, 0.99, lanes=lanes)
        elif event == "ahead":
            refused("step_ahead", many.step, taken + 2, lanes=lanes)
        elif taken == most:
            refused("budget_spent", many.step, taken + 1, level, lanes=lanes)
        elif event == "full disk":
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(os, "write", fails(errno.ENOSPC))
                message = refused("storage_full", many.step, taken + 1, level, lanes=lanes)
            assert "No space left on device" in message
        else:
            taken, last = taken + 1, here.take(request(taken + 1, level, lanes))
            if event == "no memory":  # after the step was recorded
                many.start(lanes)
                with pytest.MonkeyPatch.context() as patch:
                    patch.setattr(Play, "take", runs_out)
                    with pytest.raises(MemoryError):
                        many.step(taken, level, lanes=lanes)
            assert many.step(taken, level, lanes=lanes) == last
        status = many.status()
        assert (status.requests, status.used) == (taken, lanes * taken)
        assert status.phase == ("answering" if taken == most else "stepping")


def runs_out(*_):
    raise MemoryError


@pytest.mark.parametrize(("budget", "most"), [(64, 64), (1000, 256)])
def test_lanes_have_a_range_and_an_instance_keeps_them(tmp_path, budget, most):
    member = {"name": "deep", "setting": SETTING, "instances": 1, "budget": budget}
    with playing(online_board(tmp_path, classes=[member])) as played:
        for lanes in (0, most + 1, 2**40):
            refused("lanes_invalid", played.start, lanes)
        played.start(most)
        for _ in range(2):
            refused("start_conflict", played.start, most - 1)
            played.restart()
        played.start(most)


def test_a_step_has_one_size_and_finite_actions_which_are_clipped(played):
    played.start()
    body = request(1)
    for other in (b"\1", body[:7], body[:8], body[:-1], body + b"\0"):
        refused("step_invalid", played.send, other)
    refused("step_invalid", played.step, 1, np.nan)
    assert played.status().used == 0
    high = played.step(1, 7.0)
    played.restart()
    assert played.step(1, 7.0) == high
    assert played.status().used == LANES


def test_phases_follow_each_other(played):
    refused("instance_phase", played.step, 1)
    refused("instance_phase", played.open().challenge)
    refused("instance_phase", played.answer, HALF)
    refused("instance_phase", played.open().finish, "")
    played.start()
    played.step(1)
    refused("instance_phase", played.open().challenge)
    refused("instance_phase", played.answer, HALF)
    played.finish()
    played.finish()
    refused("instance_phase", played.step, 2)
    played.kill()
    refused("instance_phase", played.step, 2)
    played.restart()
    refused("instance_phase", played.step, 2)
    assert len(unpack_table(played.open().challenge(), 4)) == ROWS
    assert played.answer(HALF)
    assert not played.answer(HALF)
    refused("answer_conflict", played.answer, HALF * 0.5)
    played.restart()
    assert not played.answer(HALF)
    refused("instance_phase", played.step, 2)
    played.finish()


def test_answers_have_one_form(played):
    played.finish()
    for table in (HALF[1:], np.full((ROWS, 2), 0.5), pickle.dumps(HALF)):
        refused("answer_shape", played.answer, table)
    refused("answer_not_finite", played.answer, HALF * np.nan)
    assert played.answer(HALF)


def test_each_signature_is_of_the_transcript_so_far(played, monkeypatch):
    monkeypatch.setattr("leaderboard.seasons.instance.EVERY", 2)
    played.start()
    played.step(1)
    played.step(2)
    instance, body = played.open(), request(3)
    first, second = played.heads[0][1:]
    others = [
        "",
        "0" * 128,
        played.sign(played.chain(0).at(1, first)),
        played.sign(played.chain(0).at(1, second)),
        played.sign(played.chain(0).at(2, first)),
        played.sign(played.chain(1).at(2, second)),
        played.key.sign("answers", played.chain(0).at(2, second).digest, played.request.receiver),
    ]
    for other in others:
        refused("bad_signature", instance.step, body, other)
        refused("bad_signature", instance.finish, other)
    assert instance.signed is None
    played.step(3)
    assert instance.signed.content.hashes == 2
    played.step(4)
    played.finish()
    assert instance.signed.content.hashes == 4
    data = pack_table(HALF)
    for other in (*others, played.signature()):
        refused("bad_signature", instance.answer, data, other)
    assert not instance.answered
    assert played.answer(HALF)
    assert instance.signed.content.hashes == 6


def test_a_ticket_ends_with_a_signature_of_all_its_transcripts(played):
    refused("instance_phase", played.ticket.end, "")
    for instance in (0, 1):
        played.finish(instance)
        played.answer(HALF, instance)
    for other in ("", played.signature(), played.sign(played.chain(0).at(2, bytes(32)))):
        refused("bad_signature", played.ticket.end, other)
    assert played.sessions.over() == []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", fails(errno.ENOSPC))
        refused("storage_full", played.end)
    played.end()
    played.end()
    assert played.sessions.over() == [played.number]
    assert played.ticket.status.phase == "ended"
    played.restart()
    assert played.sessions.over() == [played.number]


def test_asking_for_a_ticket_reads_no_journal_and_replays_nothing(played, monkeypatch):
    """Put aside by a server that stopped, or by one that was killed; or scored, with its end."""
    monkeypatch.setattr("leaderboard.seasons.instance.EVERY", 4)
    played.start()
    for number in range(1, 11):
        played.step(number)
    records = []
    read = Journal._record
    monkeypatch.setattr(Journal, "_record", lambda *_: records.append(1) or read(*_))
    for begin_again, most in ((played.restart, 2), (played.kill, 4)):
        begin_again()
        assert played.status().requests == 10
        assert len(records) <= most
        records.clear()
        assert played.status().used == 10 * LANES
        assert records == []
    taken = []
    take = Play.take
    monkeypatch.setattr(Play, "take", lambda *_: taken.append(1) or take(*_))
    played.step(11)
    assert len(taken) == 1
    played.finish()
    played.score()
    for _ in range(2):
        played.restart()
        records.clear()
        assert played.status().requests == 11
        assert len(records) <= 3
        os.truncate(played.folder / "0.journal", (played.folder / "0.journal").stat().st_size - 1)


@pytest.mark.parametrize("fault", [b"", b"PK\x03\x04 no arrays", None])
def test_a_lost_snapshot_is_replaced_by_a_replay(played, fault):
    played.start()
    played.step(1)
    played.step(2)
    played.restart()
    snapshot = played.folder / "0.npz"
    if fault is None:
        snapshot.unlink()
    else:
        snapshot.write_bytes(fault)
    last = played.step(2)
    played.kill()
    (played.folder / "0.npz").unlink(missing_ok=True)
    assert played.step(2) == last
    played.step(3)


def test_tickets_of_earlier_versions_are_scored_but_not_played_on(played):
    old = played.board.request(played.key, 1, answers_key=None, transcript=None)
    assert not {"answers_key", "transcript"} & old.to_dict()["ticket"].keys()
    number, _ = played.store.add(old)
    refused("ticket_ended", played.sessions.ticket(number).instance(0).start, 1)
    result = scored(played.store, played.board.season, number)
    assert "signed" not in result.to_dict()["stepping"][0]


def test_a_token_opens_one_ticket(played):
    number, token, sessions = played.number, played.token, played.sessions
    played.take_ticket(1)
    for ticket, password in ((played.number, token), (number, ""), (number, "é")):
        refused("token_wrong", sessions.open, ticket, password)
    refused("ticket_unknown", sessions.open, 99, token)
    refused("instance_unknown", sessions.open(number, token).instance, 2)


@pytest.mark.parametrize("hours", [24, 0.5])
def test_a_deadline_ends_everything(tmp_path, monkeypatch, hours):
    with playing(online_board(tmp_path, ticket_hours=hours)) as played:
        played.start()
        played.step(1)
        assert played.sessions.over() == []
        set_clocks(monkeypatch, hours - 0.1)
        played.step(2)
        set_clocks(monkeypatch, hours + 0.1)
        refused("ticket_ended", played.step, 3)
        refused("ticket_ended", played.start)
        refused("ticket_ended", played.finish)
        refused("ticket_ended", played.answer, HALF)
        assert played.ticket.status.phase == "ended"
        set_clocks(monkeypatch, forward=-26, passed=25)  # set back, it extends no deadline
        with pytest.raises(BoardError, match="is behind"):
            played.step(3)


def test_an_altered_request_holds_up_no_other_ticket(played, monkeypatch):
    second = played.board.request(played.key, 1)
    played.store.add(second)
    document = played.store.ticket(played.board.season.digest, 1).document
    played.store.folder.object(document).write_bytes(second.to_bytes())
    played.restart()
    set_clocks(monkeypatch, 0, passed=25)
    assert played.sessions.over() == [2]


def test_a_closed_ticket_takes_nothing_from_requests_in_progress(played):
    played.start(instance=1)
    instance, other = played.ticket.instances
    played.finish()
    played.ticket.close()
    refused("ticket_ended", instance.answer, pack_table(HALF), "")
    assert not instance.answered
    refused("ticket_ended", other.start, LANES)
    refused("ticket_ended", other.step, request(1))
    refused("ticket_ended", other.finish, "")


def result(played, number):
    row = played.store.ticket(played.board.season.digest, number)
    return played.store.sealed_result(row)


def claimed(played):
    """The jobs that the queue has now."""
    ids = []
    while (claim := played.store.queue.claim("tests", submissions=False, jobs=True)) is not None:
        ids.append(claim.id)
    return ids


def test_a_ticket_that_nobody_played_keeps_its_name_from_nobody(played):
    name = f"Tester {played.key.public[:8]}"
    assert played.store.holder_of_name(name) == played.key.public
    played.start(lanes=48)
    played.score()
    assert played.store.holder_of_name(name) is None


def test_a_ticket_takes_nothing_while_it_is_scored_and_what_it_took_is_flushed(played, monkeypatch):
    played.finish(instance=1)
    played.start()
    played.step(1)
    flushed = []
    monkeypatch.setattr(os, "fdatasync", fails(errno.EIO))
    played.sessions.sync()  # a disk that fails for a moment ends no server
    monkeypatch.setattr(os, "fdatasync", flushed.append)
    played.sessions.attend()
    assert len(flushed) == 1
    set_clocks(monkeypatch, 0, passed=25)
    for _ in range(2):
        played.sessions.attend()
    refused("ticket_ended", played.ticket.instance(0).step, request(2))
    assert played.ticket.status.phase == "ended"
    assert claimed(played) == [played.request.id]


def test_tickets_that_cannot_be_scored_are_tried_again_after_others(played, monkeypatch):
    """The journal of ticket 1 cannot be read for a while."""
    broken = played.folder / "0.journal"
    for number in (1, 2):
        if played.number < number:
            played.take_ticket(number)
        played.start()
        played.step(1)
        played.finish()
    whole = broken.read_bytes()
    broken.write_bytes(b"no journal")
    played.restart()
    set_clocks(monkeypatch, 0, passed=25)
    work = Work(submissions=False, job=ScoreTicket((played.board.secret,)), board=SeasonStore)

    def attend():
        played.sessions.attend()
        run_scorer(played.board.path, work=work)
        return [number for number in (1, 2) if result(played, number) is not None]

    assert attend() == [2]
    assert played.sessions.over() == [1]
    assert played.store.queue.count("faults") > 0
    broken.write_bytes(whole)
    assert attend() == [1, 2]
    assert played.sessions.over() == []
    assert claimed(played) == []
    assert not list(played.folder.parent.glob("*/*.npz"))


@pytest.mark.parametrize("lanes", [1, LANES])
def test_journals_and_answers_count_on_the_board(tmp_path, lanes):
    member = {"name": "deep", "setting": SETTING, "instances": 1, "budget": 256}
    with playing(online_board(tmp_path, classes=[member])) as played:
        season = played.board.season
        played.start(lanes)
        for number in range(1, 256 // lanes):  # the budget, but for its last request
            played.step(number, lanes=lanes)
        played.finish()
        played.answer(HALF)

        def written():
            return sum(path.stat().st_size for path in played.folder.glob("0.*"))

        def counted():
            documents = len(played.request.to_bytes()) + len(to_bytes(season))
            return played.store.total_bytes() - documents

        assert 4 * 250 < written() <= counted() == played_bytes(season)
        played.score()
        [row] = played.store.entrants(season.digest)
        result = played.store.sealed_result(row)
        assert written() < counted() < played_bytes(season) + len(to_bytes(result))
        assert played_bytes(season, result) >= written()


def test_no_ticket_starts_without_room_for_its_steps(tmp_path):
    member = {"name": "deep", "setting": SETTING, "instances": 2, "budget": 4096}
    room = played_bytes(tiny_season("sealed-online", classes=[member])) * 3 // 2
    board = online_board(tmp_path, limits={"total_bytes": room}, classes=[member])
    with playing(board) as played:
        second = Signed[TicketRequest].read(board.request(played.key, 1).to_bytes())
        refused("quota", start_ticket, played.store, second)
        assert len(played.store.entrants(board.season.digest)) == 1
        played.start()
        for number in range(1, 5):
            played.step(number)
        played.score()
        assert start_ticket(played.store, second) == (2, True)


@pytest.mark.parametrize("confirmed", [False, True])
def test_answers_that_do_not_reach_the_disk_are_sent_again(played, monkeypatch, confirmed):
    """They are not stored, or only the folder could not be synced: then they are confirmed."""
    played.finish()
    if confirmed:
        monkeypatch.setattr("leaderboard.seasons.instance.io.sync_folder", fails(errno.EIO))
    else:
        monkeypatch.setattr(os, "replace", fails(errno.ENOSPC))
    for _ in range(2):
        refused("storage_full", played.answer, HALF)
    monkeypatch.undo()
    if not confirmed:
        played.restart()
        assert played.status().phase == "answering"
    assert played.answer(HALF) is not confirmed
    assert played.ticket.instance(0).answered


def test_instances_used_long_ago_leave_memory_and_large_ones_take_more(played, monkeypatch):
    def ready():
        instances = played.ticket.instances
        return [each.is_ready for each in instances]

    monkeypatch.setattr(tickets_module, "MOST_HELD_LANES", 150)
    played.start()
    played.start(instance=1)
    assert ready() == [False, True]
    played.step(1)
    assert ready() == [True, False]
    played.restart()
    monkeypatch.setattr(Instance, "weights", 2**20)
    monkeypatch.setattr(tickets_module, "MOST_HELD_LANES", 2**21 // 100)
    played.start()
    assert ready() == [True, False]
    played.start(instance=1)
    assert ready() == [False, True]
    monkeypatch.setattr(Instance, "weights", 2**22)  # no steps in the event loop
    assert ready() == [False, False]


def test_one_server_that_has_the_master_steps_a_season(played, tmp_path):
    with pytest.raises(BoardError, match="another server steps it"):
        Sessions.of_master(played.store, played.board.secret)
    other = Master.generate().write(tmp_path / "other.master")
    with pytest.raises(BoardError, match="the master of no sealed-online season"):
        Sessions.of_master(played.store, other)
    with tiny_board(tmp_path / "offline") as store:
        store.announce(tiny_season("sealed-offline"))
        with pytest.raises(BoardError, match="the master of no sealed-online season"):
            Sessions.of_master(store, played.board.secret)


def test_what_was_not_answered_scores_one(played):
    played.start()
    played.step(1)
    played.finish()
    hidden = played.ticket.hidden(0)
    states = unpack_table(played.open().challenge(), 4)
    played.answer(materialize(hidden.spec).optimal_action(states[:, :2]))
    assert played.score()
    assert not played.score()
    [row] = played.store.entrants(played.board.season.digest)
    result = played.store.sealed_result(row)
    assert result is not None
    assert result.runs[0].wd_regret < 1e-6
    assert result.runs[1].wd_regret == result.runs[1].ood_decay == 1.0
    assert result.scores.wd_regret.value == pytest.approx(0.5, abs=1e-6)
    low, high = result.scores.wd_regret.ends
    assert low < 0.5 < high
    assert [each.steps for each in result.stepping] == [LANES, 0]
    assert result.stepping[1].normalised_online_regret == 1.0
    assert all(run.spec is run.evaluation_seed is None for run in result.runs)
    played.restart()
    refused("ticket_ended", played.start)
