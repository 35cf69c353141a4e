import json

import rfc8785
from hypothesis import given
from hypothesis import strategies as st

from leaderboard.documents.plain import PlainDocument, plain_json
from leaderboard.documents.submission import Submission
from leaderboard.store import LogEntry
from sme_registry.spec import Document
from tests.leaderboard.conftest import tiny_submission

TEXT = st.text(st.characters(exclude_categories=["Cs"]))
NUMBER = st.integers(-(2**53) + 1, 2**53 - 1)
NAME = st.text(st.characters(max_codepoint=127))
PLAIN = st.recursive(
    st.none() | st.booleans() | NUMBER | TEXT,
    lambda inner: st.lists(inner) | st.dictionaries(NAME, inner),
)


@given(PLAIN)
def test_plain_json_is_canonical(value):
    assert plain_json(value) == rfc8785.dumps(value)


def test_submissions_and_log_entries_are_plain(store, key):
    signed, _ = tiny_submission(store, key, statement='Grüße, 你好 😀 \x7f\n\t"\\/')
    for document in (signed.submission, *store.log()):
        assert isinstance(document, PlainDocument)
        assert document.canonical_json() == Document.canonical_json(document)
    for kind in (Submission, LogEntry):
        schema = json.dumps(kind.model_json_schema())
        assert '"number"' not in schema
