"""Entries of a sealed-offline season: what a board accepts, and what it refuses with which code."""

import httpx
import numpy as np
import pytest

from leaderboard.documents.signed import Receiver, Signed, SigningKey
from leaderboard.documents.submission import MAX_ARTEFACT_BYTES
from leaderboard.errors import Rejection
from leaderboard.scoring.verify import verify
from leaderboard.seasons import scoring as entries
from leaderboard.seasons.season import MAX_OFFLINE_INSTANCES, Entry
from leaderboard.seasons.store import SeasonStore
from sme_registry.errors import SpecError
from sme_registry.io import sha256_of
from sme_registry.seasons.wire import pack_table
from tests.leaderboard.conftest import tiny_board
from tests.leaderboard.seasons.sealing import (
    NOTHING,
    moment,
    signed_entry,
    signed_request,
    tiny_season,
)
from tests.leaderboard.serving import authorization, serving

SEASON = tiny_season()
GOOD = pack_table(np.full((300, 1), 0.5, np.float32))
NOT_FINITE = GOOD.replace(b"\0\0\0?", b"\0\0\xc0\x7f")


def entry(store, key, *answers, **fields):
    named = [
        None if data is None else {"sha256": sha256_of(data), "size": len(data)} for data in answers
    ]
    return signed_entry(store, SEASON, key, named, **fields)


def send(store, signed, *answers):
    return entries.enter(
        store, signed, answers={sha256_of(data): data for data in answers}.__getitem__
    )


@pytest.fixture(autouse=True)
def announced(store):
    store.announce(SEASON)


def refused(store, signed, *answers):
    before = store.head
    with pytest.raises(Rejection) as error:
        send(store, signed, *answers)
    assert store.head == before
    return error.value.code


def test_an_entry_is_stored_once_with_its_answers(store, key, monkeypatch):
    read, read_answers = [], entries.read_answers

    def reading(data, *form):
        read.append(data)
        return read_answers(data, *form)

    monkeypatch.setattr(entries, "read_answers", reading)
    signed = entry(store, key, GOOD, GOOD)
    assert send(store, signed, GOOD)
    assert not send(store, signed, GOOD)
    assert read == [GOOD]
    [row] = store.entrants(SEASON.digest)
    assert (row.runs, row.policies) == (2, 2)
    assert store.objects.read(sha256_of(GOOD)) == GOOD
    assert not store.is_public(sha256_of(GOOD))


def test_bad_answers_are_refused(store, key):
    for answer, code in (
        (pack_table(np.zeros((299, 1))), "answer_shape"),
        (pack_table(np.zeros((300, 2))), "answer_shape"),
        (b"0", "answer_shape"),
        (GOOD.replace(b"<f4", b"|O4"), "answer_shape"),
        (NOT_FINITE, "answer_not_finite"),
    ):
        assert refused(store, entry(store, key, GOOD, answer), GOOD, answer) == code


def test_the_same_answers_must_fit_each_class(store, key):
    member = SEASON.to_dict()["classes"][0]
    wide = {**member, "name": "wide", "setting": {**member["setting"], "action_dim": 2}}
    classes = [{**each, "instances": 1} for each in (member, wide)]
    published = [
        {"class_name": each["name"], "instance": 0, "data": NOTHING, "challenge": NOTHING}
        for each in classes
    ]
    season = tiny_season(id="mixed", classes=classes, published=published)
    store.announce(season)
    answer = {"sha256": sha256_of(GOOD), "size": len(GOOD)}
    assert refused(store, signed_entry(store, season, key, [answer] * 2), GOOD) == "answer_shape"
    assert send(store, signed_entry(store, season, key, [answer, None]), GOOD)


def test_what_changes_between_the_check_and_the_record_is_checked_again(store, key, monkeypatch):
    signed, path = entry(store, key, GOOD, None), store.folder.object(sha256_of(GOOD))
    room = "leaderboard.seasons.scoring.check_entrant"
    with monkeypatch.context() as patch:  # as `gc` of another process
        patch.setattr(room, lambda *_: path.unlink())
        store.put_object(sha256_of(GOOD), GOOD, by=key.public)
        with pytest.raises(Rejection, match="artefact_missing"):
            entries.enter(store, signed)

    def taken(*arguments):
        other = SigningKey.generate()
        name = {"name": f"Tester {key.public[:8]}", "key": other.public}
        store.add(signed_entry(store, SEASON, other, [None, None], submitter=name))
        return check_answers(*arguments)

    check_answers = entries._check_answers
    monkeypatch.setattr("leaderboard.seasons.scoring._check_answers", taken)
    with pytest.raises(Rejection, match="name_taken"):
        send(store, signed, GOOD)


def test_bad_entries_are_refused_with_stable_codes(store, key):
    other = SigningKey.generate()
    assert refused(store, entry(store, key, GOOD), GOOD) == "answer_missing"
    assert refused(store, entry(store, key, None, None, created=moment(-30))) == "stale_time"
    oracle = {"name": "Test", "version": "1", "family": "test", "knowledge": "oracle"}
    with pytest.raises(SpecError, match="must be 'generic' or 'family'"):
        entry(store, key, None, None, method=oracle)
    name = {"submitter": {"name": "Ada", "key": key.public}}
    assert send(store, entry(store, key, None, None, **name))
    name["submitter"]["key"] = other.public
    assert refused(store, entry(store, other, None, None, **name)) == "name_taken"


def test_an_entry_that_was_signed_before_one_of_its_method_is_refused(store, key):
    assert send(store, entry(store, key, None, None, created=moment(-1)))
    older = {"created": moment(-2)}
    assert refused(store, entry(store, key, None, None, **older)) == "stale_time"
    method = {"name": "tesT", "version": "2", "family": "x", "knowledge": "generic"}
    assert refused(store, entry(store, key, None, None, **older, method=method)) == "stale_time"
    method["name"] = "Rest"
    assert send(store, entry(store, key, None, None, **older, method=method))


def test_entries_over_http_have_the_same_codes(store, key):
    digits = sha256_of(GOOD)[7:]
    known = entry(store, key, GOOD, None)
    with (
        serving(store.folder.path) as url,
        httpx.Client(base_url=url, trust_env=False) as client,
    ):
        here = Receiver(store.document.key, url)
        signed = known.content.signed(key, here)
        other = tiny_season(id="other")
        store.announce(other)
        elsewhere = signed_entry(store, other, key, [None, None])
        elsewhere = elsewhere.content.signed(key, here)
        changed = signed.to_bytes().replace(b'"Test"', b'"Best"')
        relayed = signed.content.signed(key, here._replace(address="https://relay.example"))

        def post(season, data):
            answer = client.post(f"/api/seasons/{season}/entries", content=data)
            return answer.status_code, answer.json().get("code", "")

        assert post(SEASON.id, signed.to_bytes()) == (422, "artefact_missing")
        header = {"Authorization": authorization(url, key, sha256_of(GOOD))}
        put = client.put(f"/api/objects/{digits}", content=GOOD, headers=header)
        assert put.status_code == 201
        assert post("winter", signed.to_bytes()) == (404, "season_unknown")
        assert post(SEASON.id, elsewhere.to_bytes()) == (404, "season_unknown")
        assert post(SEASON.id, changed) == (403, "bad_signature")
        assert post(SEASON.id, b"{") == (400, "not_json")
        assert post(SEASON.id, known.to_bytes()) == (403, "wrong_board")
        assert post(SEASON.id, relayed.to_bytes()) == (403, "wrong_board")
        assert [post(SEASON.id, signed.to_bytes()) for _ in range(2)] == [(201, ""), (200, "")]
        assert client.get(f"/api/objects/{digits}").status_code == 404  # nobody copies answers
    [row] = store.entrants(SEASON.digest)
    assert (row.id, row.runs, row.policies) == (signed.id, 2, 1)


def test_the_largest_season_has_entries_that_can_be_sent(store, key):
    most = MAX_OFFLINE_INSTANCES
    answers = [{"sha256": f"sha256:{i:064x}", "size": MAX_ARTEFACT_BYTES} for i in range(most)]
    signed = signed_entry(store, SEASON, key, answers, statement="x" * 2000)
    envelope = Signed[Entry].read(signed.to_bytes())
    assert envelope == signed
    assert signed.is_valid(store.document.key)
    tiny_season(instances=most)
    with pytest.raises(SpecError, match="must be at most 400 together"):
        tiny_season(instances=most + 1)


def test_a_season_with_a_list_takes_listed_keys_under_their_listed_names(store, key):
    offline = tiny_season(id="listed", admission="listed")
    online = tiny_season("sealed-online", id="tickets", admission="listed")
    for season in (offline, online):
        store.announce(season)
    entry, request = (
        signed_entry(store, offline, key, [None, None]),
        signed_request(store, online, key),
    )
    assert refused(store, entry) == "not_admitted"
    with pytest.raises(Rejection, match=r"not_admitted: .* the organiser of the season tickets"):
        store.add(request)
    assert store.admit("listed", key.public, "A Lab")
    assert send(store, entry)
    assert [row.submitter for row in store.entrants(offline.digest)] == ["A Lab"]
    with pytest.raises(Rejection, match="not_admitted"):  # each season has its own list
        store.add(request)
    store.reindex()
    assert store.admitted(offline.digest)[key.public] == "A Lab"
    assert verify(store.folder.path, board=SeasonStore).log_sequence == store.head.sequence
    for name in ("<b>", "", "x\n"):
        with pytest.raises(SpecError, match="name"):
            store.admit("tickets", key.public, name)


def test_a_full_board_and_a_key_that_has_sent_its_entries_of_a_day_lose_nothing(tmp_path, key):
    with tiny_board(tmp_path / "full", limits={"total_bytes": 100}) as store:
        store.announce(SEASON)
        assert refused(store, entry(store, key, None, None)) == "quota"
        assert store.entrants(SEASON.digest) == []
    with tiny_board(tmp_path / "few", limits={"submissions_per_day": 2}) as store:
        store.announce(SEASON)
        for version in ("1", "2"):
            assert send(store, entry(store, key, None, None, statement=version))
        assert refused(store, entry(store, key, None, None, statement="3")) == "quota"
