from __future__ import annotations

import time

import pytest

from leaderboard import intake
from leaderboard.store import ATTEMPTS, Store
from tests.leaderboard.conftest import signed_withdrawal
from tests.leaderboard.store.synthetic import synthetic_result


def test_the_oldest_is_claimed_first_and_by_one_worker_only(store, submit):
    ids = [submit(number).id for number in range(3)]
    assert store.queue.claimable() == 3
    claims = [store.queue.claim(worker) for worker in ("a", "b", "c", "d")]
    assert [claim and claim.id for claim in claims] == [*ids, None]
    assert store.queue.claimable() == 0
    assert store.queue.waiting() == 3


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


def test_a_worker_with_an_expired_claim_may_finish_if_no_other_has_claimed_since(store, submit):
    submit()
    claim = store.queue.claim("slow", seconds=0)
    assert store.queue.finish(claim, synthetic_result(store, claim.id))


def test_the_same_worker_claiming_again_is_another_attempt(store, submit):
    submit()
    first = store.queue.claim("worker", seconds=0)
    second = store.queue.claim("worker")
    assert first.worker == second.worker
    assert not store.queue.finish(first, synthetic_result(store, first.id))
    assert store.queue.finish(second, synthetic_result(store, second.id))


def test_a_heartbeat_renews_a_claim(store, submit, monkeypatch):
    at = 1000.0
    monkeypatch.setattr("leaderboard.store.queue._uptime", lambda: ("boot", at))
    submit()
    claim = store.queue.claim("worker", seconds=10)
    at = 1009.0
    assert store.queue.claim("other") is None
    assert store.queue.heartbeat(claim)
    at = 1018.0
    assert store.queue.claim("other") is None
    at = 1019.0
    assert store.queue.claim("other").attempt == 2
    assert not store.queue.heartbeat(claim)


def test_a_claim_does_not_survive_a_reboot(store, submit, monkeypatch):
    submit()
    monkeypatch.setattr("leaderboard.store.queue._uptime", lambda: ("boot one", 1e6))
    store.queue.claim("worker", seconds=1e6)
    monkeypatch.setattr("leaderboard.store.queue._uptime", lambda: ("boot two", 5.0))
    assert store.queue.claim("other").attempt == 2


@pytest.mark.parametrize("days", [-400, 400])
def test_setting_the_clock_changes_no_claim(store, submit, monkeypatch, days):
    submit(0)
    submit(1)
    claim = store.queue.claim("worker", seconds=60)
    shifted = time.time() + days * 86400
    monkeypatch.setattr(time, "time", lambda: shifted)
    monkeypatch.setattr("leaderboard.store.log.now", lambda: "2020-01-01T00:00:00Z")
    assert store.queue.claim("other").id != claim.id
    assert store.queue.claim("third") is None
    assert store.queue.heartbeat(claim)
    assert store.queue.finish(claim, synthetic_result(store, claim.id))


def test_a_released_claim_does_not_count_as_lost(store, submit):
    submit()
    for _ in range(ATTEMPTS + 2):
        store.queue.release(store.queue.claim("worker"))
    assert store.queue.claim("worker").attempt == ATTEMPTS + 3


def test_a_submission_that_lost_every_attempt_is_rejected(store, submit):
    lost, next_one = submit(0), submit(1)
    for attempt in range(1, ATTEMPTS + 1):
        claim = store.queue.claim(f"worker {attempt}")
        assert (claim.id, claim.attempt) == (lost.id, attempt)
        store.queue.abandon(claim.worker)
    assert store.queue.claim("worker").id == next_one.id
    assert store.entry(lost.id).status == "rejected"
    assert store.entry(lost.id).code == "scoring_failed"
    assert store.result(lost.id).code == "scoring_failed"
    assert store.queue.failed() == 1


def test_a_reference_row_is_retried_indefinitely(store, submit):
    references = intake.submit_references(store)
    other = submit()
    for attempt in range(1, ATTEMPTS + 3):
        claim = store.queue.claim(f"worker {attempt}")
        assert (claim.id, claim.attempt) == (references[0], attempt)
        store.queue.abandon(claim.worker)
    assert store.queue.failed() == 0
    for id in (*references, other.id):
        claim = store.queue.claim("whole")
        assert claim.id == id
        assert store.queue.finish(claim, synthetic_result(store, id))


def test_a_reference_row_rejected_by_an_earlier_version_stays_rejected(store):
    """As scorers did before: such a board is still read, and its log followed."""
    first, second = intake.submit_references(store)
    claim = store.queue.claim("worker")
    assert store.queue.finish(claim, store.queue._scoring_failed(first))
    store.reindex()
    assert store.entry(first).code == "scoring_failed"
    assert store.queue.claim("worker").id == second


def test_a_submission_withdrawn_during_scoring_gets_no_result(store, key, submit):
    signed = submit()
    claim = store.queue.claim("worker")
    store.withdraw(signed_withdrawal(signed.id, key))
    assert not store.queue.heartbeat(claim)
    assert not store.queue.finish(claim, synthetic_result(store, claim.id))
    assert store.result(signed.id) is None
    assert store.queue.claim("worker") is None


def test_a_claim_made_before_reindexing_is_no_longer_current(store, submit):
    submit()
    claim = store.queue.claim("worker")
    store.reindex()
    assert not store.queue.finish(claim, synthetic_result(store, claim.id))
    again = store.queue.claim("another")
    assert not store.queue.finish(claim, synthetic_result(store, claim.id))
    assert store.queue.finish(again, synthetic_result(store, again.id))


def test_a_result_of_another_submission_or_protocol_is_refused(store, submit):
    one, other = submit(0), submit(1)
    claim = store.queue.claim("worker")
    assert claim.id == one.id
    with pytest.raises(ValueError, match="result of"):
        store.queue.finish(claim, synthetic_result(store, other.id))
    foreign = synthetic_result(store, one.id, code="onnx_op").model_copy(
        update={"protocol": "sha256:" + "0" * 64}
    )
    with pytest.raises(ValueError, match="result of"):
        store.queue.finish(claim, foreign)


def test_claims_are_seen_by_every_store_of_the_board(store, submit):
    submit()
    with Store.open(store.folder.path) as other:
        claim = store.queue.claim("worker")
        assert other.queue.claim("other") is None
        assert other.queue.finish(claim, synthetic_result(other, claim.id))
        assert store.entries()[0].status == "scored"
