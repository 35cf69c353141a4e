import time

import pytest

from leaderboard import admission
from leaderboard.documents.signed import SigningKey
from leaderboard.errors import BoardError
from leaderboard.store import Store
from leaderboard.store.queue import retry_seconds
from tests.leaderboard.conftest import put_submission, signed_withdrawal
from tests.leaderboard.store.synthetic import synthetic_result


@pytest.fixture
def clock(monkeypatch):
    """The machine's uptime, in seconds, as a list of one number."""
    at = [1000.0]
    monkeypatch.setattr("leaderboard.store.queue.uptime", lambda: ("boot", at[0]))
    return at


def test_the_oldest_is_claimed_first_and_by_one_worker_only(store, submit):
    ids = [submit(number).id for number in range(3)]
    assert store.queue.count("claimable") == 3
    claims = [store.queue.claim(worker) for worker in ("a", "b", "c", "d")]
    assert [claim and claim.id for claim in claims] == [*ids, None]
    assert store.queue.count("claimable") == 0
    assert store.queue.count("waiting") == 3


def test_an_expired_claim_is_claimed_again_and_the_late_result_rejected(store, submit):
    submit()
    late = store.queue.claim("late", seconds=0)
    second = store.queue.claim("second")
    assert (late.attempt, second.attempt) == (1, 2)
    assert not store.queue.heartbeat(late)
    assert not store.queue.finish(late, synthetic_result(store, late.id, level=0.1))
    assert store.result(late.id) is None
    assert store.queue.finish(second, synthetic_result(store, second.id, level=0.2))
    assert store.entry(second.id).scores.wd_regret.value == pytest.approx(0.2)
    assert not store.queue.finish(second, synthetic_result(store, second.id, level=0.3))
    assert not store.queue.finish(late, synthetic_result(store, late.id, level=0.3))
    assert [entry.event for entry in store.log()] == ["opened", "received", "result"]


def test_a_worker_with_an_expired_claim_may_finish_if_nobody_has_claimed_since(store, submit):
    submit()
    slow = store.queue.claim("worker", seconds=0)
    assert store.queue.finish(slow, synthetic_result(store, slow.id))
    submit(1)
    first = store.queue.claim("worker", seconds=0)
    second = store.queue.claim("worker")  # another attempt, though of the same worker
    assert first.worker == second.worker
    assert not store.queue.finish(first, synthetic_result(store, first.id))
    assert store.queue.finish(second, synthetic_result(store, second.id))


def test_a_heartbeat_renews_a_claim(store, submit, clock):
    submit()
    claim = store.queue.claim("worker", seconds=10)
    for _ in range(2):
        clock[0] += 9.0
        assert store.queue.claim("other") is None
        assert store.queue.heartbeat(claim)
    clock[0] += 10.0
    assert store.queue.claim("other").attempt == 2
    assert not store.queue.heartbeat(claim)


def test_a_claim_does_not_survive_a_reboot(store, submit, monkeypatch):
    submit()
    monkeypatch.setattr("leaderboard.store.queue.uptime", lambda: ("boot one", 1e6))
    store.queue.claim("worker", seconds=1e6)
    monkeypatch.setattr("leaderboard.store.queue.uptime", lambda: ("boot two", 5.0))
    assert store.queue.claim("other").attempt == 2


def test_setting_the_clock_changes_no_claim(store, submit, monkeypatch):
    submit(0)
    submit(1)
    claim, real = store.queue.claim("worker", seconds=60), time.time()
    for days in (-400, 400):
        monkeypatch.setattr(time, "time", lambda at=real + days * 86400: at)
        other = store.queue.claim("other")
        assert other.id != claim.id
        assert store.queue.claim("third") is None
        assert store.queue.heartbeat(claim)
        store.queue.release(other)
    assert store.queue.finish(claim, synthetic_result(store, claim.id))


def test_a_released_claim_is_no_fault_and_an_abandoned_one_is_lost(store, submit):
    submit()
    for _ in range(3):
        store.queue.release(store.queue.claim("worker"))
    claim = store.queue.claim("dead")
    assert claim.attempt == 4
    assert store.entries()[0].faults == 0
    assert store.queue.abandon("dead")
    assert not store.queue.abandon("dead")
    assert not store.queue.heartbeat(claim)
    assert not store.queue.finish(claim, synthetic_result(store, claim.id))


def test_faults_postpone_a_submission_ever_longer_and_never_reject_it(store, submit, clock):
    faulty = submit(0)
    waits = []
    for number in range(1, 13):
        claim = store.queue.claim("worker")
        assert claim.attempt == number
        store.queue.release(claim, f"fault\nno. {number}")
        row = store.entry(faulty.id)
        assert (row.status, row.faults, row.fault) == ("waiting", number, f"fault no. {number}")
        waits.append(retry_seconds(number))
        assert store.queue.count("claimable") == (number == 1)
        assert store.queue.count("claimed") == 0
        clock[0] += waits[-1]
    assert waits[:5] == [0, 10, 20, 40, 80]
    assert waits[-1] == retry_seconds(10**6) == 3600
    claim = store.queue.claim("worker")
    assert store.queue.finish(claim, synthetic_result(store, claim.id))
    assert (store.entry(faulty.id).faults, store.entry(faulty.id).fault) == (0, "")


def test_others_are_scored_while_a_submission_is_postponed(store, submit, clock):
    faulty, next_one = submit(0), submit(1)
    for _ in range(2):
        store.queue.release(store.queue.claim("worker"), "no memory")
    assert [store.entry(each.id).faults for each in (faulty, next_one)] == [2, 0]
    assert store.queue.claim("worker").id == next_one.id
    assert store.queue.claim("worker") is None
    for _ in range(2):  # claims that are lost meanwhile postpone it no longer
        store.queue.retry()
        assert store.queue.claim("killed", seconds=60).id == faulty.id
        clock[0] += 61.0


def test_scorers_that_die_unnoticed_postpone_their_submission(store, submit, clock):
    faulty = submit()
    for number in range(1, 8):
        store.queue.claim(f"dead {number}", seconds=5)
        clock[0] += 5.0
        assert store.queue.count("claimed") == 0
        store.queue.claim("next") if number > 1 else store.queue.abandon("dead 1")
        assert store.entry(faulty.id).faults == number
        clock[0] += retry_seconds(number)
    assert store.queue.claim("worker").attempt == 8


def test_a_slow_scorer_may_still_finish_after_its_claim_ended_in_a_fault(store, submit, clock):
    submit()
    store.queue.release(store.queue.claim("one"), "no memory")
    slow = store.queue.claim("slow", seconds=5)
    clock[0] += 6.0
    assert store.queue.claim("other") is None
    assert store.queue.heartbeat(slow)
    clock[0] += 4.0
    assert store.queue.count("claimed") == 1
    assert store.queue.finish(slow, synthetic_result(store, slow.id))


def test_reference_rows_are_first_and_wait_like_others_after_a_fault(store, submit, clock):
    other = submit()
    references = admission.submit_references(store)
    claims = [store.queue.claim(f"worker {number}") for number in range(3)]
    assert [claim.id for claim in claims] == [*references, other.id]
    for _ in range(9):
        store.queue.release(claims[0], "killed")
        clock[0] += 3600
        claims[0] = store.queue.claim("worker")
        assert claims[0].id == references[0]
    for claim in claims[1:]:
        store.queue.release(claim)
    for claim in [claims[0], store.queue.claim("worker")]:
        assert store.queue.finish(claim, synthetic_result(store, claim.id))
    assert store.queue.claim("worker").id == other.id


def test_of_a_key_a_second_is_in_progress_only_while_nobody_else_waits(store, submit):
    own = [submit(number).id for number in range(3)]
    other = put_submission(store, SigningKey.generate(), 10).id
    claims = [store.queue.claim(f"worker {number}") for number in range(3)]
    assert [claim.id for claim in claims] == [own[0], other, own[1]]
    for claim in claims[:2]:
        assert store.queue.finish(claim, synthetic_result(store, claim.id))
    late = put_submission(store, SigningKey.generate(), 11).id
    assert [store.queue.claim("worker").id for _ in range(2)] == [late, own[2]]


def test_nothing_is_claimed_without_the_boards_key(store, submit):
    submit()
    key = store.folder.key.read_text()
    store.folder.key.unlink()
    with Store.open(store.folder.path) as other:
        with pytest.raises(BoardError, match=r"board\.key"):
            other.queue.claim("worker")
        store.folder.key.write_text(key)
        claim = store.queue.claim("worker")
        assert claim.attempt == 1
        assert other.queue.claim("other") is None  # every store of the board sees a claim
        assert other.queue.finish(claim, synthetic_result(other, claim.id))
        assert store.entries()[0].status == "scored"


def test_a_row_rejected_by_an_earlier_version_stays_rejected(store):
    """As scorers did before: such a board is still read, and its log followed."""
    first, second = admission.submit_references(store)
    claim = store.queue.claim("worker")
    assert store.queue.finish(claim, synthetic_result(store, first, code="scoring_failed"))
    store.reindex()
    assert store.entry(first).code == "scoring_failed"
    assert store.queue.claim("worker").id == second


def test_a_submission_withdrawn_during_scoring_gets_no_result(store, key, submit):
    signed = submit()
    claim = store.queue.claim("worker")
    store.withdraw(signed_withdrawal(store, signed.id, key))
    assert not store.queue.heartbeat(claim)
    assert not store.queue.finish(claim, synthetic_result(store, claim.id))
    assert store.result(signed.id) is None
    assert store.queue.count("waiting") == 0
    assert store.queue.claim("worker") is None


def test_a_claim_made_before_reindexing_is_no_longer_current(store, submit):
    submit()
    claim = store.queue.claim("worker")
    store.reindex()
    assert not store.queue.finish(claim, synthetic_result(store, claim.id))
    again = store.queue.claim("another")
    assert not store.queue.finish(claim, synthetic_result(store, claim.id))
    assert store.queue.finish(again, synthetic_result(store, again.id))
