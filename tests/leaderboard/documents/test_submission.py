"""Reading a signed submission: nothing is validated, or answered at length, without a signature."""

import copy
import hashlib
import json

import pytest
import rfc8785
from hypothesis import given
from hypothesis import strategies as st

from leaderboard.documents.signed import (
    MAX_BYTES,
    PlainDocument,
    Receiver,
    Signed,
    SigningKey,
    plain_json,
)
from leaderboard.documents.submission import MAX_ENTRIES, Submission
from leaderboard.errors import Rejection
from leaderboard.store.log import LogEntry
from sme_registry.spec.document import Document
from tests.leaderboard.conftest import tiny_submission

KEY, BOARD = SigningKey.generate(), "a" * 64
DIGEST = "sha256:" + "0" * 64
PLAIN = {
    "schema_version": 1,
    "track": "open",
    "suite": {"name": "x-v1", "digest": DIGEST},
    "method": {"name": "x", "version": "1", "family": "x", "knowledge": "generic"},
    "code": None,
    "submitter": {"name": "x", "key": KEY.public},
    "created": "2026-01-01T00:00:00Z",
    "runs": [{"spec": DIGEST, "seed": 0, "steps": 1, "artefact": None}],
    "runs_started": {"x": 1},
    "training": {"library": "", "hyperparameters": "", "hardware": ""},
    "statement": "",
}


def text(plain, *, signed=True, **envelope):
    """A document with this content, whatever it is; without a right signature if not `signed`."""
    signature = "0" * 128
    if signed:
        digest = "sha256:" + hashlib.sha256(rfc8785.dumps(plain)).hexdigest()
        signature = KEY.sign("submission", digest, Receiver(BOARD))
    document = {"submission": plain, "signature": signature, "board": BOARD, **envelope}
    return json.dumps(document, separators=(",", ":")).encode()


def changed(**fields):
    return {**copy.deepcopy(PLAIN), **fields}


def rejection(data):
    with pytest.raises(Rejection) as caught:
        Signed[Submission].read(data)
    return caught.value


HOSTILE = {
    "empty runs": changed(runs=[{}] * 20_000),
    "invalid runs": changed(runs=[{}] * MAX_ENTRIES),
    "unknown fields": changed(**{f"{number:x}": 1 for number in range(6000)}),
    "a long name": changed(**{"k" * 60_000: 1}),
    "classes": changed(runs_started={f"{number:x}!": [] for number in range(6000)}),
    "a long text": changed(statement="é" * 10_000),
    "nesting": changed(statement=json.loads("[" * 90 + "]" * 90)),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_content_is_validated_after_its_signature_and_answered_shortly(name):
    data = text(HOSTILE[name], signed=False)
    assert len(data) <= MAX_BYTES
    refused = rejection(data)
    assert (refused.code, len(refused.message) < 200) == ("bad_signature", True)

    refused = rejection(text(HOSTILE[name]))
    assert refused.code == "schema"
    assert len(refused.message.encode()) < 4000
    assert refused.message.count("\n") <= 6  # five faults, and how many more there are


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"", "not_json"),
        (b"\xff\xfe", "not_json"),
        (b"[]", "schema"),
        (b"{}", "bad_signature"),
        (b'{"submission": 1, "signature": "00"}', "schema"),
        (text(PLAIN, signature="0" * 127), "schema"),
        (text(PLAIN, board="0" * 63), "schema"),
        (text(PLAIN, other=1), "schema"),
        (text(PLAIN, **{"k" * 60_000: 1}), "schema"),
        (text(changed(submitter={"name": "x", "key": "0" * 63}), signed=False), "bad_signature"),
        (text(changed(statement="\ud800"), signed=False), "schema"),
        (text(changed(seed=10**4000), signed=False), "schema"),
        (text(PLAIN, signed=False).replace(b'"seed":0', b'"seed":1e999'), "schema"),
        (text(PLAIN, signed=False).replace(b'"seed":0', b'"seed":NaN'), "not_json"),
        (text(PLAIN).replace(b'"seed":0', b'"seed":0,"seed":0'), "not_json"),
        (b'{"' + b"k" * 30_000 + b'":1,"' + b"k" * 30_000 + b'":1}', "not_json"),
        (b"[" * 60_000, "not_json"),
    ],
)
def test_what_is_no_signed_document_gets_a_short_answer(data, code):
    refused = rejection(data)
    assert refused.code == code
    assert len(refused.message.encode()) < 500


def test_a_content_nested_as_deeply_as_the_parser_allows_is_refused():
    depth = 1
    while True:  # the parser's limit differs between versions of Python
        data = text(PLAIN, signed=False).replace(
            b'"seed":0', b'"seed":' + b"[" * depth + b"]" * depth
        )
        refused = rejection(data)
        if refused.code == "not_json" or len(data) > MAX_BYTES // 2:
            break
        assert refused.code == "bad_signature"
        depth *= 2


def test_a_signature_covers_every_field():
    """The board keeps the whole document, which its signature must still fit."""
    removals = [
        lambda plain: plain.pop("statement"),
        lambda plain: plain.pop("schema_version"),
        lambda plain: plain["training"].pop("library"),
        lambda plain: plain["runs"][0].pop("artefact"),
    ]
    for remove in removals:
        plain = changed()
        remove(plain)
        assert rejection(text(plain)).code == "schema"


# Canonical JSON of documents without real numbers

LETTERS = st.text(st.characters(exclude_categories=["Cs"]))
NUMBER = st.integers(-(2**53) + 1, 2**53 - 1)
NAME = st.text(st.characters(max_codepoint=127))
VALUE = st.recursive(
    st.none() | st.booleans() | NUMBER | LETTERS,
    lambda inner: st.lists(inner) | st.dictionaries(NAME, inner),
)


@given(VALUE)
def test_plain_json_is_canonical(value):
    assert plain_json(value) == rfc8785.dumps(value)


def test_submissions_and_log_entries_are_plain(store, key):
    signed, _ = tiny_submission(store, key, statement='Grüße, 你好 😀 \x7f\n\t"\\/')
    for document in (signed.content, *store.log()):
        assert isinstance(document, PlainDocument)
        assert document.canonical_json() == Document.canonical_json(document)
    for kind in (Submission, LogEntry):
        schema = json.dumps(kind.model_json_schema())
        assert '"number"' not in schema
