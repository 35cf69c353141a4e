import datetime
from functools import partial

import pytest

from leaderboard import admission
from leaderboard.documents.signed import Receiver, Signed, SigningKey
from leaderboard.documents.submission import Submission, utc
from leaderboard.errors import Rejection, ScoringFault
from leaderboard.gate import gate, sandbox
from leaderboard.scoring.worker import run_scorer
from sme_registry.io import sha256_of
from tests.leaderboard.clocks import move_clock
from tests.leaderboard.conftest import (
    document_path,
    linear_onnx,
    put_submission,
    signed_withdrawal,
    tiny_board,
    tiny_submission,
    write_bundle,
)
from tests.leaderboard.store.synthetic import synthetic_result

ANY_TIME = "2000-01-01T00:00:00Z"


def put(store, key, artefacts):
    for digest, data in artefacts.items():
        store.put_object(digest, data, by=key.public)


def objects(store):
    return [path for path in store.folder.objects.rglob("*") if path.is_file()]


def code_of(call):
    with pytest.raises(Rejection) as caught:
        call()
    assert caught.value.message.endswith(".")
    return caught.value.code


def receive(store, signed):
    """Admit a submission from its bytes, as a server does."""
    read = Signed[Submission].read(signed.to_bytes())
    admission.admit(store, read)
    return read.id


def resigned(store, key, plain):
    return Submission.from_dict(plain).signed(key, Receiver(store.document.key))


def uploaded(store, key, number=0, **fields):
    """A submission whose artefacts the key has uploaded."""
    signed, artefacts = tiny_submission(store, key, number, **fields)
    put(store, key, artefacts)
    return signed


def with_artefact(store, key, data):
    """A submission of a file that is on the board, whatever it is."""
    digest = sha256_of(data)
    put(store, key, {digest: data})
    plain = tiny_submission(store, key)[0].content.to_dict()
    for run in plain["runs"]:
        run["artefact"] = {"sha256": digest, "size": len(data)}
    return resigned(store, key, plain)


def after(**duration):
    return datetime.datetime.now(datetime.UTC) + datetime.timedelta(**duration)


# Submissions.


def test_a_submission_is_kept_once_and_known_at_any_age(store, key, monkeypatch):
    signed, artefacts = tiny_submission(store, key)
    assert code_of(lambda: receive(store, signed)) == "artefact_missing"
    put(store, key, artefacts)
    with monkeypatch.context() as patch:
        move_clock(patch, utc(after(days=15)))
        assert code_of(lambda: receive(store, signed)) == "stale_time"
    assert store.entries() == []
    assert receive(store, signed) == signed.id
    assert receive(store, signed) == signed.id
    move_clock(monkeypatch, utc(after(days=999)))
    assert receive(store, signed) == signed.id
    assert [entry.id for entry in store.entries()] == [signed.id]
    assert store.head.sequence == 1


def test_an_artefact_that_another_key_uploaded_is_missing(store, key):
    """Its digest is public as soon as a submission names it, its bytes only later."""
    signed, artefacts = tiny_submission(store, key)
    put(store, key, artefacts)
    copier = SigningKey.generate()
    copy, _ = tiny_submission(store, copier)
    before = code_of(lambda: receive(store, copy))
    receive(store, signed)
    assert (before, code_of(lambda: receive(store, copy))) == ("artefact_missing",) * 2
    other, _ = tiny_submission(store, copier, 7)
    with pytest.raises(Rejection) as of_nothing:
        receive(store, other)
    with pytest.raises(Rejection) as of_another:
        receive(store, copy)
    one, two = (
        each.value.message.partition(": ")[2] for each in (of_nothing, of_another)
    )  # nothing shows whether the board has it
    assert one == two
    assert [entry.id for entry in store.entries()] == [signed.id]
    put(store, copier, artefacts)  # who has its bytes may submit it, and is marked as a copy
    assert receive(store, copy) == copy.id


def test_a_key_submits_its_artefact_again_without_another_upload(store, key):
    signed = uploaded(store, key)
    receive(store, signed)
    again, artefacts = tiny_submission(store, key, statement="revised")
    store.reindex()  # forgets who uploaded what was not submitted
    assert receive(store, again) == again.id
    # An upload without the bytes is no upload.
    copier = SigningKey.generate()
    (digest,) = artefacts
    assert code_of(lambda: store.put_object(digest, b"", by=copier.public)) == "artefact_digest"
    assert not store.possesses(copier.public, digest)


def test_a_name_belongs_to_the_first_key_that_uses_it(store, key):
    put_submission(store, key, 1, submitter={"name": "A Lab", "key": key.public})
    assert store.holder_of_name("a lab") == key.public  # while it waits
    for number, name in enumerate(["A Lab", "a lab"], 2):
        other = SigningKey.generate()
        imitation = uploaded(store, other, 2, submitter={"name": name, "key": other.public})
        assert code_of(lambda signed=imitation: receive(store, signed)) == "name_taken"
        mine = uploaded(store, key, number, submitter={"name": name, "key": key.public})
        assert receive(store, mine) == mine.id


def test_policies_that_are_rejected_occupy_no_name(store, key):
    put_submission(store, key, 1, submitter={"name": "A Lab", "key": key.public})
    claim = store.queue.claim("worker")
    assert store.queue.finish(claim, synthetic_result(store, claim.id, code="run_failed"))
    assert store.holder_of_name("a lab") is None


def test_two_keys_that_send_a_name_at_once_do_not_share_it(store, key, monkeypatch):
    keys = (key, SigningKey.generate())
    one, two = (
        uploaded(store, each, n, submitter={"name": "A Lab", "key": each.public})
        for n, each in enumerate(keys)
    )
    real = admission._check_files

    def meanwhile(*arguments):
        real(*arguments)
        store.receive(one)

    monkeypatch.setattr(admission, "_check_files", meanwhile)
    assert code_of(lambda: receive(store, two)) == "name_taken"


def test_public_documents_that_strangers_send_again_count_for_nobody(tmp_path, key):
    """Submissions to other boards and withdrawn ones, with their signatures."""
    with tiny_board(tmp_path / "b", limits={"submissions_per_day": 2}) as store:
        gone = put_submission(store, key, 1)
        store.withdraw(signed_withdrawal(store, gone.id, key))
        elsewhere = gone.content.signed(key, Receiver("a" * 64))
        for signed, code in 2 * ((gone, "withdrawn"), (elsewhere, "wrong_board")):
            envelope = Signed[Submission].read(signed.to_bytes())
            assert code_of(partial(admission.admit, store, envelope)) == code
        last = Signed[Submission].read(uploaded(store, key, 2).to_bytes())
        assert admission.admit(store, last)


def test_an_artefact_of_another_size_or_width_is_refused_and_a_failed_run_needs_none(store, key):
    plain = uploaded(store, key).content.to_dict()
    (run,) = plain["runs"]
    other = {**run, "artefact": {**run["artefact"], "size": run["artefact"]["size"] - 1}}
    small = resigned(store, key, {**plain, "runs": [other]})
    assert code_of(lambda: receive(store, small)) == "artefact_digest"
    wide = with_artefact(store, key, linear_onnx(986, observation_dim=5))
    assert code_of(lambda: receive(store, wide)) == "onnx_interface"
    assert store.entries() == []
    runs = [run, {**run, "seed": 9, "artefact": None}]
    failed = resigned(store, key, {**plain, "runs": runs, "runs_started": {"Tiny": 2}})
    assert receive(store, failed) == failed.id


def test_only_the_confined_process_reads_policies_and_its_faults_refuse_nobody(
    store, key, monkeypatch
):
    def no_process(*arguments):
        raise ScoringFault("no process")

    monkeypatch.setattr(gate, "read", lambda *arguments: pytest.fail("read in this process"))
    monkeypatch.setattr(admission, "_verdicts", {})
    signed = uploaded(store, key)
    with monkeypatch.context() as patch:
        patch.setattr(sandbox, "start", no_process)
        for _ in range(2):
            with pytest.raises(ScoringFault):
                receive(store, signed)
    assert store.entries() == []
    assert receive(store, signed) == signed.id


def test_the_daily_quota_frees_up_at_the_stated_time(tmp_path, key, monkeypatch):
    with tiny_board(tmp_path / "b", limits={"submissions_per_day": 2}) as store:
        put_submission(store, key, 1)
        put_submission(store, key, 2)
        signed = uploaded(store, key, 3)
        first = store.submission_times(key.public, ANY_TIME)[0]
        free = datetime.datetime.fromisoformat(first) + datetime.timedelta(days=1)
        with pytest.raises(Rejection, match=f"quota: .* after {utc(free)}") as caught:
            receive(store, signed)
        assert caught.value.code == "quota"
        move_clock(monkeypatch, utc(free + datetime.timedelta(seconds=2)))
        put(store, key, tiny_submission(store, key, 3)[1])  # its upload has expired
        assert receive(store, signed) == signed.id


def test_a_full_queue_accepts_only_references_and_faults_make_room_in_it(tmp_path, key):
    with tiny_board(tmp_path / "b", limits={"waiting_submissions": 1}) as store:
        put_submission(store, key, 1)
        signed = uploaded(store, key, 2)
        assert code_of(lambda: receive(store, signed)) == "quota"
        claim = store.queue.claim("worker")
        store.queue.release(claim, "no memory")
        assert receive(store, signed) == signed.id
        assert (store.queue.count("waiting"), store.queue.count("queued")) == (2, 1)
        assert len(admission.submit_references(store)) == 2  # without them nothing is ever shown


# Bundles.


def test_a_bundle_that_is_refused_leaves_nothing(tmp_path, store, key):
    signed, artefacts = tiny_submission(store, key, created=ANY_TIME)
    folder = write_bundle(tmp_path / "old", signed, artefacts)
    assert code_of(lambda: admission.submit_bundle(store, folder)) == "stale_time"
    signed, artefacts = tiny_submission(store, key)
    folder = write_bundle(tmp_path / "changed", signed, dict.fromkeys(artefacts, b"?"))
    assert code_of(lambda: admission.submit_bundle(store, folder)) == "artefact_digest"
    assert (objects(store), store.entries()) == ([], [])


def test_a_bundle_for_no_board_is_signed_for_the_board_it_is_sent_to(tmp_path, store, key):
    signed, artefacts = tiny_submission(store, key)
    folder = write_bundle(tmp_path / "bundle", signed.content.signed(key), artefacts)
    assert code_of(lambda: admission.submit_bundle(store, folder)) == "wrong_board"
    other = SigningKey.generate()
    assert code_of(lambda: admission.submit_bundle(store, folder, other)) == "bad_signature"
    elsewhere = write_bundle(
        tmp_path / "other", signed.content.signed(key, Receiver("a" * 64)), artefacts
    )
    assert code_of(lambda: admission.submit_bundle(store, elsewhere, key)) == "wrong_board"
    assert admission.submit_bundle(store, folder, key) == signed.id
    assert store.submission(signed.id) == signed


# The board's own rows.


def test_reference_rows_exist_once_however_often_submitted(tmp_path, monkeypatch):
    with tiny_board(tmp_path / "b", instances=2) as store:
        ids = admission.submit_references(store)
        assert admission.submit_references(store) == ids
        rows = store.entries()
        assert [row.id for row in rows] == ids
        assert [row.method for row in rows] == ["optimal", "constant"]
        assert [row.knowledge for row in rows] == ["oracle", "family"]
        assert all(row.reference and row.runs == 2 for row in rows)
        opened = store.log(0, 1)[0].time
        created = {store.submission(id).content.created for id in ids}
        assert created == {opened}
        # Other versions may write other bytes.
        others = [each._replace(onnx=lambda _: linear_onnx(7)) for each in admission.REFERENCES]
        monkeypatch.setattr(admission, "REFERENCES", others)
        assert admission.submit_references(store) == ids
        assert len(store.entries()) == 2


def test_an_old_board_accepts_its_reference_rows_whatever_else_has_their_name(
    store, key, monkeypatch
):
    entry = store.log(0, 1)[0].model_copy(update={"time": "2020-01-01T00:00:00Z"})
    monkeypatch.setattr(store, "log", lambda *_: [entry])
    method = {"name": "optimal", "version": "1", "family": "reference", "knowledge": "oracle"}
    put_submission(store, key, method=method)
    assert len(admission.submit_references(store)) == 2
    assert [row.reference for row in store.entries()] == [False, True, True]


# Withdrawals.


def test_only_the_submitter_withdraws_for_this_board_and_in_plain_text(store, key):
    """A submission's id is the same on every board, so only the signature names the board."""
    signed = put_submission(store, key)
    refused = [
        (signed_withdrawal(store, signed.id, SigningKey.generate()), "bad_signature"),
        (signed_withdrawal(store, signed.id, store.folder.signing_key()), "bad_signature"),
        (signed_withdrawal(store, "sha256:" + "0" * 64, key), "unknown_submission"),
    ]
    for board in (None, "a" * 64):
        withdrawal = signed_withdrawal(store, signed.id, key).content
        elsewhere = withdrawal.signed(key, Receiver(board))
        relabelled = elsewhere.model_copy(update={"board": store.document.key})
        refused += [(elsewhere, "wrong_board"), (relabelled, "bad_signature")]
    for letter in "\x1b\x00\r\u202e\u2028":
        unsafe = signed_withdrawal(store, signed.id, key, f"a bug{letter}[2J")
        refused.append((unsafe, "unsafe_name"))
    for withdrawal, code in refused:
        assert code_of(partial(admission.withdraw, store, withdrawal)) == code
    assert store.withdrawal(signed.id) is None
    assert admission.withdraw(
        store, signed_withdrawal(store, signed.id, key, "ein Käfer <b>,\nzweite Zeile")
    )


# Uploads.


def test_an_upload_is_signed_for_one_object_one_board_and_one_address(store, key):
    this, that = "sha256:" + "1" * 64, "sha256:" + "2" * 64
    here, there = "https://board.example", "https://other.example"

    def sender(header, digest=this, address=here):
        return admission.uploader(store.document, header, digest, address)

    header = admission.upload_header(key, this, Receiver(store.document.key, here))
    assert sender(header) == key.public
    assert code_of(lambda: sender(header, that)) == "bad_signature"
    assert code_of(lambda: sender(None)) == "bad_signature"
    assert code_of(lambda: sender(header, address=there)) == "wrong_board"
    for name, value, other in (
        ("board", store.document.key, "b" * 64),
        ("address", here, there),
    ):
        changed = admission.upload_header(
            key, this, Receiver(store.document.key, here)._replace(**{name: other})
        )
        without = header.replace(f"{name}={value},", "")
        assert code_of(partial(sender, changed)) == "wrong_board"
        assert code_of(partial(sender, without)) == "wrong_board"
        assert code_of(partial(sender, changed.replace(other, value))) == "bad_signature"

    time = utc(datetime.datetime.now(datetime.UTC))  # what signs a submission signs no upload
    receiver = Receiver(store.document.key, here)
    forged = header.rpartition("=")[0] + "=" + key.sign("submission", f"{this} {time}", receiver)
    assert code_of(lambda: sender(forged)) == "bad_signature"


def test_upload_quotas_count_stored_bytes_of_a_day(tmp_path, key, monkeypatch):
    limits = {"upload_bytes_per_day": 1000, "total_bytes": 2000, "artefact_bytes": 900}
    with tiny_board(tmp_path / "b", limits=limits) as store:
        put(store, key, {sha256_of(bytes(500)): bytes(500)})
        admission.check_upload(store, key.public, 500)
        assert code_of(lambda: admission.check_upload(store, key.public, 501)) == "quota"
        move_clock(monkeypatch, utc(after(days=1, seconds=2)))
        admission.check_upload(store, key.public, 900)


def test_documents_count_like_artefacts(store, key):
    put(store, key, {sha256_of(b"12345"): b"12345"})  # which no submission names
    signed = put_submission(store, key)
    (artefact,) = {run.artefact.size for run in signed.content.runs if run.artefact}
    used = 5 + artefact + len(signed.to_bytes())
    assert store.uploaded_bytes(key.public, ANY_TIME) == store.total_bytes() == used
    assert run_scorer(store.folder.path) == 1
    used += document_path(store.folder.path, signed.id, "result").stat().st_size
    assert store.uploaded_bytes(key.public, ANY_TIME) == used
    store.withdraw(signed_withdrawal(store, signed.id, key))
    used += document_path(store.folder.path, signed.id, "withdrawal").stat().st_size
    assert store.total_bytes() == used
    store.reindex()
    assert store.total_bytes() == used


# Room on a full board.


def test_uploads_without_a_submission_expire_after_an_hour(tmp_path, key, monkeypatch):
    limits = {"total_bytes": 1000, "artefact_bytes": 900}
    one, two = sha256_of(b"1" * 300), sha256_of(b"2" * 300)
    with tiny_board(tmp_path / "full", limits=limits) as store:
        put(store, key, {one: b"1" * 300, two: b"2" * 300})
        move_clock(monkeypatch, utc(after(minutes=40)))
        other = SigningKey.generate()
        assert code_of(lambda: admission.check_upload(store, other.public, 500)) == "quota"
        put(store, other, {one: b"1" * 300})
        move_clock(monkeypatch, utc(after(minutes=61)))
        admission.check_upload(store, other.public, 500)
        assert [digest for digest, _ in store.objects.paths()] == [one]
        assert store.possesses(other.public, one)
        assert not store.possesses(key.public, one)
        assert store.total_bytes() == 300
        assert store.uploaded_bytes(key.public, ANY_TIME) == 600  # towards the quota of its day
        move_clock(monkeypatch, utc(after(hours=26)))
        admission.check_upload(store, other.public, 500)
        assert store.uploaded_bytes(key.public, ANY_TIME) == store.total_bytes() == 0
